"""An electric car whose bus has voltage and current of the battery, through its DBC file: what the battery feeds."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_logs import ask

from estimator.can_io.frames import Frames
from estimator.can_io.log_writer import write_log
from estimator.config import load
from estimator.preparation.power_at_rest import IDLE_SD, MIN_IDLE, REST_SD, REST_SHARE, powers_at_rest
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Role

Cli = Callable[..., tuple[int, str, str]]
DBC = """VERSION ""
BS_:
BU_: X
BO_ 256 MOTION: 8 X
 SG_ Speed : 0|16@1+ (0.01,0) [0|655] "km/h" X
BO_ 258 BATTERY: 8 X
 SG_ Voltage : 0|16@1+ (0.1,0) [0|6000] "V" X
 SG_ Current : 16|16@1- (0.1,0) [-3000|3000] "A" X
BO_ 259 PEDALS: 8 X
 SG_ Brake : 0|2@1+ (1,0) [0|3] "" X
"""
SETTINGS = """
bus.dbc = ["car.dbc"]
[signals]
speed = "MOTION.Speed"
battery_voltage = "BATTERY.Voltage"
battery_current = "BATTERY.Current"
brake_switch = "PEDALS.Brake"
[vehicle]
discharge_current = "negative"
[prior]
mass_kg = [500, 5000]
A_N = [0, 1000]
C_N_s2_m2 = [0, 3]
[gate]
acceleration_step_m_s2 = 0.25
relative_sd = [0.2, 1.0, 0.05]
"""
MASS, A, C = 1500.0, 160.0, 0.38
AUXILIARIES, HEATER, TIME = 400.0, 5000.0, 300.0  # W, W, s
REGAINED = 0.6  # share of the braking power at the wheels that reaches the battery


def speeds(minutes: float, rng: np.random.Generator) -> Floats:
    """City and country, 10 Hz [m/s]: targets for half a minute each, every third a stop."""
    n = round(600 * minutes)
    v, target = np.zeros(n), 0.0
    for k in range(1, n):
        if k % 300 == 1:
            target = 0.0 if k // 300 % 3 == 0 else rng.uniform(7.0, 30.0)
        v[k] = max(v[k - 1] + 0.1 * np.clip(0.4 * (target - v[k - 1]), -1.8, 1.6), 0.0)
    v[v < 0.05] = 0.0
    return v


def car(folder: Path, heater: float, regained: float, minutes: float = 12.0, sign: int = -1) -> tuple[Path, Path]:
    """A log of the car, and its configuration; ``sign`` is that of the current while it drives."""
    rng = np.random.default_rng(3)
    v = speeds(minutes, rng)
    t = 0.1 * np.arange(len(v))
    at_wheels = A * v + C * v**3 + MASS * v * np.gradient(v, 0.1)
    power = np.where(at_wheels > 0, at_wheels, regained * at_wheels) + AUXILIARIES + heater * np.exp(-t / TIME)
    volts = 380.0 + rng.normal(0, 0.2, len(v))
    amperes = sign * (power + rng.normal(0, 300.0, len(v))) / volts
    sent = np.round(3.6 * (v + rng.normal(0, 0.004, len(v)) * (v > 0)) / 0.01).clip(0)
    return log(folder, t, sent, np.round(10 * volts), np.round(10 * amperes)), settings(folder)


def log(folder: Path, t: Floats, speed: Floats, volts: Floats, amperes: Floats) -> Path:
    """As raw values on the bus; the service brake is never used."""
    data = np.zeros((3 * len(t), 8), dtype=np.uint8)
    data[::3, :2] = speed.astype("<u2")[:, None].view(np.uint8)
    data[1::3, :2] = volts.astype("<u2")[:, None].view(np.uint8)
    data[1::3, 2:4] = amperes.astype("<i2")[:, None].view(np.uint8)
    ident = np.tile(np.array([256, 258, 259], dtype=np.uint32), len(t))
    times = 1.7e9 + np.repeat(t, 3) + np.tile([0.0, 0.002, 0.004], len(t))
    write_log(Frames(times, ident, np.full(len(times), 8, dtype=np.uint8), data), folder / "car.blf")
    return folder / "car.blf"


def settings(folder: Path) -> Path:
    (folder / "car.dbc").write_text(DBC)
    (folder / "car.toml").write_text(SETTINGS)
    return folder / "car.toml"


@pytest.fixture(scope="module")
def cold(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return car(tmp_path_factory.mktemp("cold"), HEATER, 1.0)


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return car(tmp_path_factory.mktemp("lossy"), 0.0, REGAINED, 30.0)


def effects_of(answer: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {effect["name"]: effect for effect in answer["effects"]}


@pytest.mark.slow
def test_a_cabin_heater_is_named_with_its_size(cold):
    answer = ask("diagnose", cold[0], "--config", cold[1])
    found = effects_of(answer)
    assert answer["verdict"] == "effect"
    assert set(found) <= {"cabin_heater", "auxiliary_load"}
    heater = found["cabin_heater"]["magnitude"]
    assert abs(heater["value"] - HEATER) < 3 * heater["sd"] + 0.05 * HEATER


@pytest.mark.nightly
@pytest.mark.slow
def test_what_is_lost_in_regeneration_is_named_with_its_size(lossy):
    found = effects_of(ask("diagnose", lossy[0], "--config", lossy[1]))
    assert "regeneration_loss" in found
    size = found["regeneration_loss"]["magnitude"]
    assert size["value"] == pytest.approx((1 - REGAINED) / REGAINED, rel=0.2)


@pytest.mark.slow
def test_with_the_heater_in_the_model_the_mass_is_that_of_the_car(cold):
    answer = ask("estimate", cold[0], "--config", cold[1], "--effect", "cabin_heater")
    mass = answer["parameters"]["mass_kg"]
    assert answer["effects"] == ["cabin_heater"]
    assert abs(mass["mean"] - MASS) < 3 * mass["sd"]
    assert mass["sd"] < 0.02 * MASS


# The sign of the current


@pytest.mark.parametrize(("sign", "word"), [(-1, "negative"), (1, "positive")])
def test_a_proposal_has_the_sign_of_the_current_by_the_log(tmp_path: Path, cli: Cli, sign: int, word: str) -> None:
    drive, _ = car(tmp_path, HEATER, REGAINED, 3.0, sign)
    assert cli("init", tmp_path / "car.dbc", drive, "-o", tmp_path / "new.toml")[0] == 0
    assert load(tmp_path / "new.toml").vehicle.discharge_current == word
    assert f'discharge_current = "{word}"  # by the log' in (tmp_path / "new.toml").read_text()


@pytest.mark.parametrize("has_log", [False, True], ids=["no log", "level speed"])
def test_a_proposal_says_that_the_sign_of_the_current_is_not_known(tmp_path: Path, cli: Cli, has_log: bool) -> None:
    _, file = car(tmp_path, HEATER, REGAINED, 0.1)
    n = 1200
    level = log(tmp_path, 0.1 * np.arange(n), 6000 + np.arange(n) % 2, 3800 + np.arange(n) % 2, np.arange(n) % 5)
    code, out, _ = cli("init", file.with_name("car.dbc"), *[level] * has_log)
    assert code == 0
    assert 'discharge_current = "positive"  # no log shows it: "negative" if' in out


@pytest.mark.slow
@pytest.mark.parametrize("given", ["positive", "negative"])
def test_an_estimate_with_the_other_sign_names_the_key(tmp_path: Path, cli: Cli, given: str) -> None:
    drive, file = car(tmp_path, 0.0, 1.0, sign=-1 if given == "positive" else 1)
    file.write_text(SETTINGS.replace('"negative"', f'"{given}"'))
    other = "negative" if given == "positive" else "positive"
    _, out, _ = cli("estimate", drive, "--config", file)
    assert f'if the battery current has the other sign, write [vehicle] discharge_current = "{other}"' in out
    assert "to do" not in out


# The power at rest


def standing(power: Floats, context: dict[Role, Floats]) -> list[Rows]:
    n = len(power)
    fresh = np.ones((n, 2), dtype=bool)
    return [Rows(index=np.arange(n), speed=np.zeros(n), power=power, fresh=fresh, context=context)]


def test_a_battery_gives_one_figure_for_every_minute_at_rest():
    minutes = 3
    t = STEP * np.arange(round(60 * minutes / STEP))
    power = 1000.0 * (1 + np.floor(t / 60))
    found = powers_at_rest(standing(power, {Role.BATTERY_CURRENT: power / 380}), 0.0)
    assert [rest.power for rest in found] == [1000.0, 2000.0, 3000.0]
    assert [rest.sd for rest in found] == [REST_SD + REST_SHARE * rest.power for rest in found]
    assert [rest.elapsed for rest in found] == pytest.approx([30.0, 90.0, 150.0], abs=STEP)
    assert {rest.engine_speed for rest in found} == {0.0}


def test_an_engine_gives_one_figure_once_it_has_idled_for_long():
    n = round(MIN_IDLE / STEP)
    for rows, expected in ((n, 1), (n - 1, 0)):
        found = powers_at_rest(standing(np.full(rows, 4e3), {Role.ENGINE_SPEED: np.full(rows, 63.0)}), 0.0)
        assert len(found) == expected
    assert powers_at_rest(standing(np.full(n, 4e3), {Role.ENGINE_SPEED: np.zeros(n)}), 0.0) == ()
    idle = powers_at_rest(standing(np.full(n, 0.0), {Role.ENGINE_SPEED: np.full(n, 63.0)}), 0.0)
    assert [(rest.power, rest.sd, rest.engine_speed) for rest in idle] == [(0.0, IDLE_SD, 63.0)]
