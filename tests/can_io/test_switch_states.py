"""Switches, ranges and J1939 messages of databases that do not say what they are: bound rightly, or told."""

from pathlib import Path

import numpy as np
import pytest
from project_paths import TESTS

from estimator.can_io.binding import bind, load_database
from estimator.can_io.frames import Frames
from estimator.can_io.signal_values import values
from estimator.can_io.switch_states import is_on, states_of
from estimator.config import from_dict, load
from estimator.errors import MissingInputsError
from estimator.estimates import Status
from estimator.samples import Rows
from estimator.signals import Role
from estimator.streaming import replay
from estimator.streaming.inspection import inspect
from estimator.streaming.remarks import SwitchUse

CASES = TESTS / "databases"


@pytest.mark.parametrize(
    ("text", "state"),
    [
        ("Not_Applied", False),
        ("Applied", True),
        ("BrakePressed", True),
        ("BRAKE_NOT_PRESSED", False),
        ("Brake pedal depressed", True),
        ("Brake pedal released", False),
        ("INACTIVE", False),
        ("Driver_applying_brakes", True),
        ("iB_BrakePedalApplied_NotApplied", False),
        ("Off", False),
        ("on", True),
        ("No", False),
        ("Yes", True),
        ("nicht betätigt", False),
        ("betaetigt", True),
        ("Not available", None),
        ("notAvailable", None),
        ("NotInit_orOff", None),
        ("Faulty_SNA", None),
        ("N/A", None),
        ("Error", None),
        ("Reserved", None),
        ("3", None),
        ("", None),
    ],
)
def test_texts_of_states(text: str, state: bool | None) -> None:
    assert is_on(text) is state


@pytest.mark.parametrize(("text", "pressed"), [("Clutch open", True), ("engaged", False), ("Not engaged", True)])
def test_a_clutch_that_is_open_has_its_pedal_pressed(text: str, pressed: bool) -> None:
    assert is_on(text, is_clutch=True) is pressed
    assert is_on(text) is not pressed


@pytest.mark.parametrize(
    "table",
    [{}, {0: "Pressed", 1: "Depressed"}, {0: "A", 1: "B"}, {0: "Not available", 1: "On"}, {0: "0 %", 1: "50 %"}],
)
def test_a_table_that_does_not_name_both_states_decides_nothing(table: dict[int, str]) -> None:
    assert states_of(table, 1.0, 0.0) is None


def read_switch(folder: Path, table: str, role: str = "brake_switch", states: list[int] | None = None) -> list[float]:
    """What the raw values 0 to 3 of a switch mean."""
    text = f'VERSION ""\nBO_ 256 CAR: 8 X\n SG_ Brake : 4|2@1+ (1,0) [0|0] "" X\nVAL_ 256 Brake {table} ;\n'
    (folder / "car.dbc").write_text(text)
    bus = {} if states is None else {"states": {"CAR.Brake": states}}
    config = from_dict({"signals": {role: "CAR.Brake"}, "bus": bus})
    (message,) = bind(config, load_database([str(folder / "car.dbc")]))
    data = np.zeros((4, 8), dtype=np.uint8)
    data[:, 0] = np.arange(4) << 4
    frames = Frames(np.arange(4.0), np.full(4, 256, np.uint32), np.full(4, 8, np.uint8), data)
    return values(message, message.signals[0], frames)[0].tolist()


@pytest.mark.parametrize(
    ("table", "states", "meaning"),
    [
        ('0 "Invalid" 1 "Not_Applied" 2 "Applied" 3 "Faulty"', None, [np.nan, 0, 1, np.nan]),
        ('0 "Pressed" 1 "Released"', None, [1, 0, 0, 0]),
        ('0 "Off" 1 "On" 2 "Error" 3 "Not available"', None, [0, 1, np.nan, np.nan]),
        ('0 "A" 1 "B"', None, [0, 1, 2, 3]),
        ("", [2], [0, 0, 1, 0]),
        ('0 "Invalid" 1 "A" 2 "B" 3 "C"', [2, 3], [np.nan, 0, 1, 1]),
        ('0 "Pressed" 1 "Released"', [1], [0, 1, 0, 0]),
    ],
)
def test_what_the_values_of_a_switch_mean(
    tmp_path: Path, table: str, states: list[int] | None, meaning: list[float]
) -> None:
    np.testing.assert_array_equal(read_switch(tmp_path, table, states=states), meaning)


@pytest.mark.slow
def test_brake_codes_1_not_applied_2_applied_give_the_mass() -> None:
    config = load(CASES / "brake_1_off_2_on.toml")
    run = replay.estimate_logs([CASES / "brake_1_off_2_on.log.gz"], config)
    assert run.final.status == Status.ESTIMATED
    assert run.final.mass is not None
    assert run.final.mass.q05 - 30 < 1500 < run.final.mass.q95 + 30
    assert run.pipeline.traffic.remarks == []


@pytest.mark.slow
def test_a_switch_that_is_on_for_most_of_the_driving_is_told() -> None:
    tables = {"states": {"CAR.Brake": [1]}, "dbc": [str(CASES / "brake_1_off_2_on.dbc")]}
    signals = {"speed": "CAR.Speed", "engine_power": "CAR.Power", "brake_switch": "CAR.Brake"}
    answer = inspect(CASES / "brake_1_off_2_on.log.gz", from_dict({"signals": signals, "bus": tables}))
    (remark,) = answer.warnings
    assert remark.startswith("CAR.Brake (brake_switch) is on for 9")
    assert '[bus] states = { "CAR.Brake" = [' in remark


def used(speed: np.ndarray, least_power: float = 0.0, **context: np.ndarray) -> list[str]:
    """Remarks on a drive with these values, fed in two parts; the power [W] is least for the last second of driving."""
    roles = {Role(name): value for name, value in context.items()}
    n = len(speed)
    power = np.where(np.arange(n) < np.flatnonzero(speed)[-1] - 10, 9e3, least_power)
    rows = Rows(index=np.arange(n), speed=speed, power=power, fresh=np.ones((n, 2), bool), context=roles)
    use = SwitchUse()
    use.feed([rows[: n // 3], rows[n // 3 :]])
    return use.remarks({role: f"CAR.{role}" for role in roles})


def stop_and_go(stops: int) -> np.ndarray:
    return np.tile(np.r_[np.full(700, 15.0), np.zeros(100)], stops)


@pytest.mark.parametrize("value", [0.0, 3.0, np.nan])
def test_a_brake_that_never_comes_on_though_the_vehicle_stops_is_told(value: float) -> None:
    speed = stop_and_go(3)
    (remark,) = used(speed, brake_switch=np.full(len(speed), value))
    assert remark.startswith("CAR.brake_switch (brake_switch) never shows a brake, though the vehicle stopped 3 times")
    assert used(speed, brake_switch=np.full(len(speed), value), brake_pedal=0.3 * (speed == 0)) == []
    assert used(stop_and_go(1), brake_switch=np.full(800, value)) == []
    assert used(speed) == []


def test_a_power_that_never_falls_to_zero_though_no_brake_is_bound_is_told() -> None:
    (remark,) = used(stop_and_go(3), 1.5e3)
    assert remark.startswith("no brake is bound, and the power never falls to 0, though the vehicle stopped 3 times")
    assert used(stop_and_go(1), 1.5e3) == []
    assert used(stop_and_go(3), -1.5e3) == []


def test_a_brake_pedal_that_is_not_zero_at_rest_is_told() -> None:
    speed = stop_and_go(3)
    (remark,) = used(speed, brake_pedal=np.full(len(speed), 0.02))
    assert remark.startswith("CAR.brake_pedal (brake_pedal) is on for 100 % of the driving above 5 m/s")


@pytest.mark.slow
def test_values_that_the_range_of_another_model_drops_are_told() -> None:
    config = load(CASES / "range_too_small.toml")
    answer = inspect(CASES / "range_too_small.log.gz", config)
    (remark,) = answer.warnings
    assert remark.startswith("5 % of the values of CAR.Power (engine_power) lie outside its range -25 .. 25 kW ")
    signals = {str(role): path for role, path in config.signals.items()}
    bus = {"dbc": config.bus.dbc, "ranges": {"CAR.Power": [-500, 500]}}
    assert inspect(CASES / "range_too_small.log.gz", from_dict({"signals": signals, "bus": bus})).warnings == ()


def test_a_j1939_database_that_does_not_say_so_is_told_with_its_cure() -> None:
    log, config = CASES / "j1939_rts_cts.log.gz", load(CASES / "j1939_no_frame_format.toml")
    with pytest.raises(MissingInputsError, match=r'the group of CCVS1, EEC1 .* write \[bus\] match = "pgn" into'):
        replay.estimate_logs([log], config)
    signals = {str(role): path for role, path in config.signals.items()}
    cured = from_dict(
        {
            "signals": signals,
            "vehicle": {"reference_torque_Nm": 2500},
            "bus": {"dbc": config.bus.dbc, "match": "pgn"},
        }
    )
    assert set(inspect(log, cured).inputs) == {Role.SPEED, Role.TORQUE_FRACTION, Role.ENGINE_SPEED}
