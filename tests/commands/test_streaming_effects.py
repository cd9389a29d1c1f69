"""Effects in the model that estimates: `roadload estimate --effect NAME`, and `effects` in the configuration."""

from pathlib import Path
from typing import Any

import pytest
from simulated_logs import CLIMB, TRUCK, ask, drive, written

from estimator.commands.main import main
from estimator.signals import Role
from estimator.simulation.effects.effect import Effect

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def hills(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("hills") / "hills.blf"
    return written(drive("mixed", 20, 6, Effect(name="grade", magnitude=0.01)), path)


@pytest.fixture(scope="module")
def bends(tmp_path_factory) -> Path:
    recording = drive(
        "mixed", 25, 1, Effect(name="cornering", magnitude=900.0), without=[*CLIMB, Role.FAN_SPEED, Role.HEADING]
    )
    return written(recording, tmp_path_factory.mktemp("bends") / "bends.blf")


@pytest.fixture(scope="module")
def graded(hills) -> dict[str, Any]:
    return ask("estimate", hills, "--config", config(hills.parent), "--effect", "grade")


def config(folder: Path, text: str = "") -> Path:
    """A configuration with ``text`` and one update, of the whole drive."""
    path = folder / "c.toml"
    path.write_text(f"{text}[gate]\ninterval_s = 1e6\n")
    return path


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def holds(marginal: dict[str, float], truth: float, sds: float = 3.0) -> bool:
    return abs(marginal["mean"] - truth) < sds * marginal["sd"]


def test_signals_of_the_road_are_used_without_being_asked_for(hills, graded):
    plain = ask("estimate", hills, "--config", config(hills.parent))
    assert (plain["effects"], graded["effects"]) == ([], ["grade"])
    assert plain["parameters"] == graded["parameters"]
    assert "altitude" in graded["road"]["shown_by"]
    assert graded["status"] == "estimated"
    mass = graded["parameters"]["mass_kg"]
    assert mass["q05"] < TRUCK.mass < mass["q95"]
    assert mass["sd"] < 0.05 * TRUCK.mass
    assert holds(graded["parameters"]["A_N"], TRUCK.A)
    assert holds(graded["parameters"]["C_N_s2_m2"], TRUCK.C)


def test_the_configuration_says_the_same_as_the_command_line(hills, graded, tmp_path):
    """Named in both it is one effect all the same."""
    answer = ask("estimate", hills, "--config", config(tmp_path, 'effects = ["grade"]\n'), "--effect", "grade")
    assert answer == graded


@pytest.mark.nightly
def test_replay_knows_the_effects_too(hills, graded, tmp_path):
    """On the bus as from the file, to the last bit."""
    replayed = ask("replay", hills, "--config", config(tmp_path, 'effects = ["grade"]\n'))
    for key in ("parameters", "effects", "magnitudes", "rms_kW"):
        assert replayed[key] == graded[key]


def test_an_effect_of_its_own_size_has_a_posterior(bends):
    once = "--config", config(bends.parent)
    plain, bent = ask("estimate", bends, *once), ask("estimate", bends, *once, "--effect", "cornering")
    size = bent["magnitudes"]["cornering"]
    assert set(size) == {"mean", "sd", "q05", "q50", "q95"}
    assert holds(size, 900.0)
    assert 0 < size["sd"] < 200
    assert bent["rms_kW"] < plain["rms_kW"]
    assert holds(bent["parameters"]["mass_kg"], TRUCK.mass)
    assert plain["magnitudes"] == {}


@pytest.mark.parametrize(
    ("name", "needs"),
    [
        ("headwind", "heading"),
        ("auxiliary_cycling", "fan_speed"),
    ],
)
def test_an_effect_without_its_signal_is_a_reason_not_a_guess(bends, name, needs):
    answer = ask("estimate", bends, "--config", config(bends.parent), "--effect", name)
    assert answer["status"] == "unestimated"
    assert answer["reason"] == f"the effect {name} needs {needs}, which the bus does not carry"
    assert answer["advice"] == f"leave the effect {name} out, or bind {needs} and give a log that has it"
    mass = answer["parameters"]["mass_kg"]
    assert (mass["status"], mass["reason"], mass["mean"]) == ("unestimated", answer["reason"], None)


def test_names_are_checked(bends, tmp_path, capsys):
    file = config(tmp_path, 'effects = ["gravity"]\n')
    for arguments in (("--effect", "gravity"), ("--config", file)):
        error = refused(capsys, "estimate", bends, *arguments)
        assert "'gravity' is not known; there are grade, headwind, " in error
    assert "only diagnosed" in refused(capsys, "estimate", bends, "--effect", "drafting")
    wrong = config(tmp_path, 'effects = "grade"\n')
    assert "effects" in refused(capsys, "estimate", bends, "--config", wrong)


CONFLICTS = [
    ('[sampler]\nlikelihood = "paper"\n', 'sampler.likelihood: "paper" has the plain road load only'),
]


@pytest.mark.parametrize(("table", "complaint"), CONFLICTS)
@pytest.mark.parametrize("command", ["estimate", "diagnose"])
def test_what_contradicts_an_effect_is_refused(bends, tmp_path, capsys, command, table, complaint):
    file = config(tmp_path, f'effects = ["grade"]\n{table}')
    assert complaint in refused(capsys, command, bends, "--config", file)


@pytest.mark.parametrize(("table", "complaint"), CONFLICTS)
@pytest.mark.parametrize("command", ["estimate", "diagnose"])
def test_the_command_line_is_checked_like_the_file(bends, tmp_path, capsys, command, table, complaint):
    assert complaint in refused(capsys, command, bends, "--config", config(tmp_path, table), "--effect", "grade")
