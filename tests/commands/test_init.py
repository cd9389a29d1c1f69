"""From a database and a log to a configuration that estimates, without reading a manual."""

import gzip
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from project_paths import ROOT, TESTS

from estimator.can_io.binding import load_database
from estimator.can_io.role_candidates import candidates, wheels
from estimator.config import Config, load
from estimator.settings import Section
from estimator.settings_comments import comments_of
from estimator.signals import Role

CASES = TESTS / "databases"
EXAMPLE = ROOT / "examples" / "own_vehicle"

Cli = Callable[..., tuple[int, str, str]]
CAR = """VERSION ""
BO_ 256 ENGINE_DATA: 8 X
 SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|250] "kph" X
 SG_ EngineRPM : 16|16@1+ (1,0) [0|15000] "rpm" X
 SG_ EngineTorqueEstimate : 32|16@1- (1,0) [-1000|1000] "Nm" X
 SG_ EngineTorqueRequest : 48|16@1- (1,0) [-1000|1000] "Nm" X
BO_ 300 WHEELS: 8 X
 SG_ WheelSpeedFL : 0|16@1+ (0.01,0) [0|250] "kph" X
 SG_ WheelSpeedFR : 16|16@1+ (0.01,0) [0|250] "kph" X
 SG_ CruiseSetSpeed : 32|8@1+ (1,0) [0|250] "kph" X
 SG_ SteeringTorque : 40|16@1- (0.1,0) [-100|100] "Nm" X
BO_ 301 PEDALS: 8 X
 SG_ BrakePedal : 0|2@1+ (1,0) [0|3] "" X
 SG_ ParkBrake : 2|2@1+ (1,0) [0|3] "" X
 SG_ Gear : 8|4@1+ (1,0) [0|15] "" X
VAL_ 301 BrakePedal 1 "Not_Applied" 2 "Applied" ;
VAL_ 301 ParkBrake 0 "A" 1 "B" ;
VAL_ 301 Gear 0 "P" 1 "R" 2 "N" 3 "D" ;
"""


def car(folder: Path) -> Path:
    path = folder / "car.dbc"
    path.write_text(CAR)
    return path


def test_signals_find_their_roles(tmp_path: Path) -> None:
    found = candidates(load_database([str(car(tmp_path))]))
    best = {role.value: fit[0].path for role, fit in found.items()}
    assert (
        best.items()
        >= {
            "speed": "ENGINE_DATA.VehicleSpeed",
            "engine_speed": "ENGINE_DATA.EngineRPM",
            "engine_torque": "ENGINE_DATA.EngineTorqueEstimate",
            "brake_switch": "PEDALS.BrakePedal",
        }.items()
    )
    assert [candidate.path for candidate in wheels(found[Role.WHEEL_SPEEDS])] == [
        "WHEELS.WheelSpeedFL",
        "WHEELS.WheelSpeedFR",
    ]
    paths = {candidate.path for fit in found.values() for candidate in fit}
    assert not paths & {"WHEELS.CruiseSetSpeed", "WHEELS.SteeringTorque", "ENGINE_DATA.EngineTorqueRequest"}


def test_what_is_proposed_is_a_configuration_that_fits(tmp_path: Path, cli: Cli) -> None:
    output = tmp_path / "car.toml"
    assert cli("init", car(tmp_path), "-o", output)[0] == 0
    config = load(output)
    assert config.signals == {
        "speed": "ENGINE_DATA.VehicleSpeed",
        "engine_torque": "ENGINE_DATA.EngineTorqueEstimate",
        "engine_speed": "ENGINE_DATA.EngineRPM",
        "brake_switch": "PEDALS.BrakePedal",
    }
    assert config.prior.mass_kg[1] < 10_000
    status, out, _ = cli("check", "--config", output)
    assert status == 0
    assert "ENGINE_DATA.EngineRPM" in out
    # Values whose meaning is not known are proposed in comments.
    text = output.read_text()
    assert '# park_brake = "PEDALS.ParkBrake"' in text
    assert '# gear = "PEDALS.Gear"' in text


def proposed(text: str, folder: Path, cli: Cli) -> dict[str, object]:
    """The signals of the configuration that is proposed for a database."""
    database, output = folder / "some.dbc", folder / "some.toml"
    database.write_text(f'VERSION ""\n{text}')
    assert cli("init", database, "-o", output)[0] == 0
    return dict(load(output).signals)


def test_the_example_of_an_own_vehicle_is_bound_as_by_hand(tmp_path: Path, cli: Cli) -> None:
    """Its DRIVE.Speed is named by its message and its unit alone."""
    output = tmp_path / "van.toml"
    assert cli("init", EXAMPLE / "van.dbc", "-o", output)[0] == 0
    assert load(output).signals == load(EXAMPLE / "van.toml").signals


def test_a_log_without_a_message_of_the_database_is_refused(tmp_path: Path, cli: Cli) -> None:
    output = tmp_path / "car.toml"
    code, _, err = cli("init", car(tmp_path), EXAMPLE / "van.blf", "-o", output)
    assert code == 2
    assert f"van.blf: nothing of {car(tmp_path)} that is of use comes in it" in err
    assert not output.exists()


def test_a_database_without_a_useful_signal_is_proposed_with_what_is_to_be_written(tmp_path: Path, cli: Cli) -> None:
    database = tmp_path / "door.dbc"
    database.write_text('VERSION ""\nBO_ 256 DOOR: 8 X\n SG_ Open : 0|1@1+ (1,0) [0|1] "" X\n')
    code, out, _ = cli("init", database, EXAMPLE / "van.blf")
    assert code == 0
    assert "# No signal was found for speed" in out


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (
            'BO_ 101 EPS_STATUS: 8 X\n SG_ MotorTorque : 0|16@1- (1,0) [-900|900] "Nm" X\n',
            "the message is of the steering",
        ),
        ('BO_ 101 B: 8 X\n SG_ Torque : 0|16@1- (1,0) [-9|9] "Nm" X\n', "its range is that of a small motor"),
        ('BO_ 101 B: 8 X\n SG_ EngTorqueLost : 0|16@1- (1,0) [-900|900] "Nm" X\n', "it is a loss"),
        (
            'BO_ 101 B: 8 X\n SG_ EngineTorque : 0|5@1- (10,0) [0|0] "" X\n'
            f"VAL_ 101 EngineTorque {' '.join(f'{i} {chr(34)}s{i}{chr(34)}' for i in range(16))} ;\n",
            "its values are states",
        ),
    ],
)
def test_name_message_range_and_values_all_count(other: str, why: str, tmp_path: Path, cli: Cli) -> None:
    right = """BO_ 102 MOTOR: 8 X
 SG_ TqFeedback : 0|16@1- (1,0) [-900|900] "Nm" X
 SG_ Rpm : 16|16@1+ (1,0) [0|9000] "rpm" X
"""
    assert proposed(other + right, tmp_path, cli)["engine_torque"] == "MOTOR.TqFeedback", why


def test_power_is_taken_from_signals_that_belong_together(tmp_path: Path, cli: Cli) -> None:
    """Voltage and current of one message, and no power of one axle of two."""
    text = """BO_ 101 FRONT: 8 X
 SG_ FrontMotorPower : 0|16@1- (0.1,0) [-300|300] "kW" X
BO_ 102 REAR: 8 X
 SG_ RearMotorPower : 0|16@1- (0.1,0) [-300|300] "kW" X
BO_ 103 A: 8 X
 SG_ BatteryVoltage : 0|16@1+ (0.1,0) [0|500] "V" X
BO_ 104 HV: 8 X
 SG_ PackVoltage2 : 0|16@1+ (0.1,0) [0|500] "V" X
 SG_ PackCurrent2 : 16|16@1- (0.1,0) [-500|500] "A" X
"""
    assert proposed(text, tmp_path, cli) == {"battery_voltage": "HV.PackVoltage2", "battery_current": "HV.PackCurrent2"}


def test_estimates_of_others_are_references_and_no_inputs(tmp_path: Path, cli: Cli) -> None:
    text = """BO_ 615 DI_vehicleEstimates: 8 X
 SG_ DI_mass : 0|10@1+ (5,1900) [1900|7010] "kg" X
 SG_ DI_gradeEst : 10|7@1- (1,0) [-40|40] "%" X
"""
    found = proposed(text, tmp_path, cli)
    assert found == {
        "mass_reference": "DI_vehicleEstimates.DI_mass",
        "grade_reference": "DI_vehicleEstimates.DI_gradeEst",
    }


def test_the_same_goes_to_standard_output(tmp_path: Path, cli: Cli) -> None:
    output = tmp_path / "car.toml"
    cli("init", car(tmp_path), "-o", output)
    status, out, err = cli("init", car(tmp_path))
    assert (status, out, err) == (0, output.read_text(), "")


@pytest.mark.parametrize(
    ("signals", "missing"),
    [
        ('speed = "ENGINE_DATA.VehicleSpeed"', "torque_fraction, engine_speed, reference_torque"),
        (
            'engine_torque = "ENGINE_DATA.EngineTorqueEstimate"\nengine_speed = "ENGINE_DATA.EngineRPM"',
            "speed or wheel_speeds",
        ),
    ],
)
def test_check_says_what_is_missing(signals: str, missing: str, tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "weak.toml"
    database = tmp_path / "car.dbc"
    database.write_text(CAR)
    path.write_text(f'[bus]\ndbc = ["{database}"]\n[signals]\n{signals}\n')
    status, out, _ = cli("check", "--config", path)
    assert status == 1
    reason = f"no signal for {missing}; start the configuration (--config FILE.toml) with signals = {{speed = "
    assert f"the model cannot be fed: {reason}" in " ".join(out.split())
    status, out, _ = cli("check", "--config", path, "--json")
    assert status == 1
    assert json.loads(out)["reason"].startswith(reason)


def test_a_shipped_configuration_is_checked_by_its_name(cli: Cli) -> None:
    assert cli("check", "--config", "obd2")[::2] == (0, "")


def test_nothing_is_overwritten(tmp_path: Path, cli: Cli) -> None:
    output = tmp_path / "car.toml"
    output.write_text("mine")
    status, _, err = cli("init", car(tmp_path), "-o", output)
    assert status == 2
    assert err == f"error: {output}: exists; give another name, or remove it first\n"
    assert output.read_text() == "mine"


def test_units_that_the_database_lacks_are_proposed_as_guesses(tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "bare.dbc"
    path.write_text(CAR.replace('"kph"', '""').replace('"rpm"', '""'))
    output = tmp_path / "bare.toml"
    assert cli("init", path, "-o", output)[0] == 0
    assert load(output).bus.units == {"ENGINE_DATA.VehicleSpeed": "km/h", "ENGINE_DATA.EngineRPM": "rpm"}
    assert "guessed" in output.read_text()
    assert cli("check", "--config", output)[0] == 0


def test_a_database_without_speed_and_power_says_so(tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "other.dbc"
    path.write_text('VERSION ""\nBO_ 256 SEAT: 8 X\n SG_ Height : 0|8@1+ (1,0) [0|0] "mm" X\n')
    status, out, _ = cli("init", path)
    assert status == 0
    assert "# No signal was found for speed: write speed or wheel_speeds here." in out
    assert "# No signal was found for power: write engine_power or " in out


UNNAMED = """VERSION ""
BO_ 256 ESP_21: 8 X
 SG_ ESP_v_Signal : 0|16@1+ (0.01,0) [0|400] "MPH" X
BO_ 300 BMS_01: 8 X
 SG_ KL_Spannung : 0|16@1+ (0.01,0) [0|600] "V" X
 SG_ HV_Spannung : 16|16@1+ (0.1,0) [0|600] "V" X
 SG_ HV_Strom : 32|16@1- (0.1,0) [-1000|1000] "A" X
 SG_ Zelle : 48|8@1+ (0.02,0) [0|5] "V" X
"""


def test_signals_whose_names_say_nothing_stand_in_comments_by_their_units(tmp_path: Path, cli: Cli) -> None:
    database, log = tmp_path / "unnamed.dbc", tmp_path / "drive.log"
    database.write_text(UNNAMED)
    rows = []
    for i in range(200):
        volts = (1200 + i).to_bytes(2, "little") + (3600 + i).to_bytes(2, "little")
        rows.append(f"({i / 10:.6f}) can0 100#{(i * 20).to_bytes(8, 'little').hex()}")
        rows.append(f"({i / 10:.6f}) can0 12C#{(volts + i.to_bytes(4, 'little')).hex()}")
    log.write_text("\n".join(rows) + "\n")
    lines = {
        "ESP_21.ESP_v_Signal": "speed",
        "BMS_01.HV_Strom": "battery_current",
        "BMS_01.HV_Spannung": "battery_voltage",
    }
    for inputs in ([database], [database, log]):
        status, out, _ = cli("init", *inputs)
        assert status == 0
        assert all(f'# {role} = "{path}"' in out for path, role in lines.items())
        assert "Zelle" not in out
    assert out.index("BMS_01.HV_Spannung") < out.index("BMS_01.KL_Spannung")  # of 12 V, as the log shows
    assert '# speed = "ESP_21.ESP_v_Signal"  # MPH; 10 Hz, 0 .. ' in out


def test_signals_are_guessed_by_their_units_only_where_nothing_is_proposed(tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "car.dbc"
    path.write_text(CAR + UNNAMED.partition("\n")[2])
    assert "_Signal" not in cli("init", path)[1]
    assert "Spannung" not in cli("init", path)[1]


@pytest.mark.parametrize(
    ("files", "said"),
    [(["a.log"], "a.log: is no .dbc file"), (["a.dbc", "a.log", "b.log"], "b.log: is a second log")],
)
def test_files_that_init_does_not_take(cli: Cli, files: list[str], said: str) -> None:
    status, _, err = cli("init", *files)
    assert status == 2
    assert err.startswith(f"error: {said}; give ")


def test_a_log_tells_what_is_on_the_bus(tmp_path: Path, cli: Cli) -> None:
    rows = []
    for i in range(200):
        data = (i * 10).to_bytes(2, "little") + (1000 + i).to_bytes(2, "little") + bytes(4)
        rows.append(f"({i / 10:.6f}) can0 12C#{data.hex().upper()}")
        rows.append(f"({i / 10:.6f}) can0 100#{bytes(8).hex().upper()}")
    log = tmp_path / "drive.log"
    log.write_text("\n".join(rows) + "\n")
    status, out, _ = cli("init", car(tmp_path), log)
    assert status == 0
    assert 'wheel_speeds = ["WHEELS.WheelSpeedFL", "WHEELS.WheelSpeedFR"]  # kph; 10 Hz, 0 .. 19.9 km/h' in out
    assert '# speed = "ENGINE_DATA.VehicleSpeed"  # kph; 10 Hz, 0 .. 0 km/h, hardly changes' in out
    assert '# brake_switch = "PEDALS.BrakePedal"  # 1 Not_Applied, 2 Applied; not in the log' in out


def test_a_reference_torque_that_comes_in_packets_is_bound(tmp_path: Path, cli: Cli) -> None:
    """EC1 has more than 8 bytes, and never changes; without it no power follows from a torque in per cent."""
    lines = gzip.decompress((CASES / "j1939_rts_cts.log.gz").read_bytes()).decode().splitlines()
    for i, line in enumerate(lines):
        lines[i] = line.replace("0CF00400#F07D96002C", f"0CF00400#F07D{150 + i % 50:02X}{i % 200:02X}2C")
        lines[i] = lines[i].replace("18FEF100#F30030", f"18FEF100#F3{i % 200:02X}30")
    (tmp_path / "drive.log").write_text("\n".join(lines) + "\n")
    status, out, _ = cli("init", ROOT / "dbc" / "j1939.dbc", tmp_path / "drive.log")
    assert status == 0
    assert '\ntorque_fraction = "EEC1.ActualEngPercentTorque"' in out
    assert '\nreference_torque = "EC1.EngReferenceTorque"  # Nm; 0.1 Hz, 2500 .. 2500 N m' in out


def test_parameter_groups_from_other_addresses_are_found(cli: Cli) -> None:
    status, out, _ = cli("init", CASES / "j1939_no_frame_format.dbc", CASES / "j1939_rts_cts.log.gz")
    assert status == 0
    assert 'match = "pgn"' in out


@pytest.mark.slow
def test_from_a_database_and_a_log_to_an_estimate(tmp_path: Path, cli: Cli, recordings: Path) -> None:
    folder = recordings / "bmw_i3"
    output = tmp_path / "i3.toml"
    assert cli("init", folder / "bmw_i3.dbc", folder / "TripA02.blf", "-o", output)[0] == 0
    assert load(output).signals["engine_torque"] == "MOTOR.MotorTorque"
    status, out, _ = cli("estimate", folder / "TripA02.blf", folder / "TripA04.blf", "--config", output)
    assert status == 0
    assert out.startswith("estimated")


# --- check, and the settings that it prints --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('speed = "ENGINE_DATA.VehicelSpeed"', "has no signal 'VehicelSpeed'; did you mean VehicleSpeed?"),
        ('speed = "ENGINE_DATE.VehicleSpeed"', "no message 'ENGINE_DATE'; the nearest are ENGINE_DATA"),
        ('sped = "ENGINE_DATA.VehicleSpeed"', "signals.sped: no such role; did you mean speed?"),
    ],
)
def test_check_without_a_log_finds_what_is_mistyped(tmp_path: Path, cli: Cli, line: str, said: str) -> None:
    car(tmp_path)
    (tmp_path / "car.toml").write_text(f'bus.dbc = ["car.dbc"]\n[signals]\n{line}\n')
    for more in ([], ["--print-config"]):
        status, _, err = cli("check", "--config", tmp_path / "car.toml", *more)
        assert status == 2
        assert said in err
        assert err.count("\n") == 1


def test_check_without_a_log_refuses_what_an_estimate_refuses(tmp_path: Path, cli: Cli) -> None:
    car(tmp_path)
    file = tmp_path / "car.toml"
    assert cli("init", tmp_path / "car.dbc", "-o", file)[0] == 0
    file.write_text('effects = ["grde"]\n' + file.read_text())
    checked = cli("check", "--config", file)
    assert checked == cli("estimate", EXAMPLE / "van.blf", "--config", file)
    status, out, err = checked
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {file}: effects: 'grde' is not known; did you mean grade?")


def test_a_mistyped_command_names_the_nearest(cli: Cli) -> None:
    status, _, err = cli("estimat", "a.log")
    assert status == 2
    assert "did you mean estimate?" in err


def test_settings_that_are_printed_hold_in_any_folder(
    tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    car(tmp_path)
    (tmp_path / "car.toml").write_text('bus.dbc = ["car.dbc"]\nsignals.speed = "ENGINE_DATA.VehicleSpeed"\n')
    monkeypatch.chdir(tmp_path)
    status, out, _ = cli("check", "--config", "car.toml", "--print-config")
    assert status == 0
    other = tmp_path / "other"
    other.mkdir()
    (other / "printed.toml").write_text(out)
    monkeypatch.chdir(other)
    assert load("printed.toml") == load(tmp_path / "car.toml")
    assert "mass_kg = [500.0, 100000.0]  # lowest and highest\n" in out


TABLES = [type(table) for name in Config.__struct_fields__ if isinstance(table := getattr(Config(), name), Section)]


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_every_key_has_a_comment(table: type[Section]) -> None:
    comments = comments_of(table)
    assert list(comments) == list(table.__struct_fields__)
    assert all(text and "\n" not in text for text in comments.values())


def test_answers_that_come_in_segments_are_seen_in_the_log(tmp_path: Path, cli: Cli) -> None:
    """Voltage and current of an electric car: an answer of 20 bytes in three frames, every 0.2 s."""
    (tmp_path / "ev.dbc").write_text("""VERSION ""
BU_: X
BO_ 902 WHEELS: 8 X
 SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|300] "km/h" X
BO_ 2028 BMS: 20 X
 SG_ Service M : 7|8@0+ (1,0) [0|0] "" X
 SG_ DID m98M : 15|16@0+ (1,0) [0|0] "" X
 SG_ BatteryCurrent m257 : 103|16@0- (0.1,0) [0|0] "A" X
 SG_ BatteryVoltage m257 : 119|16@0+ (0.1,0) [0|0] "V" X

SG_MUL_VAL_ 2028 DID Service 98-98;
SG_MUL_VAL_ 2028 BatteryCurrent DID 257-257;
SG_MUL_VAL_ 2028 BatteryVoltage DID 257-257;
""")
    lines = []
    for i in range(200):
        values = (10 * i % 900).to_bytes(2, "big") + (3600 + i).to_bytes(2, "big")
        answer = (bytes([98, 1, 1]).ljust(12, b"\0") + values).ljust(20, b"\0")
        parts = [b"\x10\x14" + answer[:6], b"\x21" + answer[6:13], b"\x22" + answer[13:]]
        rows = [(0x386, (50 * i).to_bytes(2, "little") + bytes(6)), *((0x7EC, part) for part in parts)]
        lines += [
            f"({1000 + i / 5 + k / 500:.6f}) can0 {ident:03X}#{data.hex()}" for k, (ident, data) in enumerate(rows)
        ]
    (tmp_path / "ev.log").write_text("\n".join(lines) + "\n")
    assert cli("init", tmp_path / "ev.dbc", tmp_path / "ev.log", "-o", tmp_path / "ev.toml")[0] == 0
    signals = {"battery_voltage": "BMS.BatteryVoltage", "battery_current": "BMS.BatteryCurrent"}
    assert load(tmp_path / "ev.toml").signals == {"speed": "WHEELS.VehicleSpeed", **signals}
