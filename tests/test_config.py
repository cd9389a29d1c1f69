"""The configuration file: what is wrong is said in one line that names the file and the key."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from estimator.config import J1939_BINDING, Config, from_dict, load
from estimator.errors import ConfigError
from estimator.settings import Section
from estimator.signals import DIMENSION, Role


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "truck.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def test_no_file_and_an_empty_file_are_the_defaults(tmp_path: Path) -> None:
    assert load(None) == Config()
    assert load(write(tmp_path, "")) == Config()


def test_the_defaults_pass_their_own_checks() -> None:
    assert from_dict(msgspec.to_builtins(Config())) == Config()
    assert from_dict({"signals": msgspec.to_builtins(Config().binding)}).binding == J1939_BINDING
    assert set(DIMENSION) == set(Role)


def test_databases_are_relative_to_the_file(tmp_path: Path) -> None:
    config = load(write(tmp_path, 'bus.dbc = ["a.dbc", "../b.dbc", "/c.dbc"]'))
    assert config.bus.dbc == [str(tmp_path / "a.dbc"), str(tmp_path / "../b.dbc"), "/c.dbc"]


def test_whole_numbers_serve_where_numbers_are_wanted(tmp_path: Path) -> None:
    assert load(write(tmp_path, "prior.mass_kg = [1000, 2000]")).prior.mass_kg == (1000.0, 2000.0)


SECTIONS = [name for name, value in msgspec.structs.asdict(Config()).items() if isinstance(value, Section)]


@pytest.mark.parametrize("section", SECTIONS)
def test_unknown_key_in_any_table(tmp_path: Path, section: str) -> None:
    message = refusal(write(tmp_path, f"[{section}]\nfrobnicate = 1"))
    assert message.startswith(f"{section}.frobnicate: no such key; ")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('efects = ["grade"]', "efects: no such key; did you mean effects?"),
        ("[sampler]\nkernal = 1", "sampler.kernal: no such key; did you mean kernel?"),
        ("[service]\nx = 1", "service.x: no such key; there are state_directory, runtime_directory, "),
        ('[sampler]\nlikelihood = "foo"', "sampler.likelihood: 'foo' is none of 'road', 'paper'"),
        (
            '[sampler]\nlikelihood = "instruments"',
            "sampler.likelihood: 'instruments' is no longer there: it had no road",
        ),
        ('[kinematics]\nacceleration = "inertial"', "kinematics.acceleration: is no longer needed: an accelerometer"),
        ("[admission]\npower_sigmas = 2", "admission.power_sigmas: belonged to the samples of earlier versions"),
        ("[vehicle]\ndriveline_efficiency = 95", "vehicle.driveline_efficiency: Expected `float` <= 1.0, found 95"),
    ],
)
def test_what_there_is_instead_is_said(tmp_path: Path, text: str, said: str) -> None:
    assert refusal(write(tmp_path, text)).startswith(said)


def test_unknown_table(tmp_path: Path) -> None:
    assert "frobnicate: no such key; " in refusal(write(tmp_path, "[frobnicate]\nx = 1"))


NUMBERS = [
    f"{section}.{key}"
    for section in SECTIONS
    for key, value in msgspec.structs.asdict(getattr(Config(), section)).items()
    if isinstance(value, float) or key == "reference_torque_Nm"
]


@pytest.mark.parametrize("value", ["nan", "-nan", "inf", "-inf"])
@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_that_are_none(tmp_path: Path, key: str, value: str) -> None:
    assert refusal(write(tmp_path, f"{key} = {value}")).startswith(f"{key}: {float(value)} is not")


@pytest.mark.parametrize("key", [key for key in NUMBERS if key != "kinematics.maximum_lag_s"])
def test_no_number_may_be_negative(tmp_path: Path, key: str) -> None:
    assert refusal(write(tmp_path, f"{key} = -1")).startswith(f"{key}: Expected `float` >")


@pytest.mark.parametrize(
    ("text", "key", "said"),
    [
        ("prior.mass_kg = [nan, 5]", "prior.mass_kg[0]", "nan"),
        ("prior.mass_kg = [1, inf]", "prior.mass_kg[1]", "inf"),
        ("gate.relative_sd = [0.5, nan, 0.1]", "gate.relative_sd[1]", "nan"),
        ("gate.relative_sd = [0.5, 0.1]", "gate.relative_sd", "length 3"),
        ("prior.mass_kg = [5000, 5000]", "prior.mass_kg", "empty"),
        ("prior.A_N = [20, 10]", "prior.A_N", "empty"),
        ("prior.C_N_s2_m2 = [-1, 10]", "prior.C_N_s2_m2", "negative"),
        ("prior.mass_kg = 5000", "prior.mass_kg", "array"),
        ("prior.mass_kg = [true, 5000]", "prior.mass_kg[0]", "bool"),
        ("vehicle = 3", "vehicle", "object"),
        ("vehicle.driveline_efficiency = 1.01", "vehicle.driveline_efficiency", "<= 1.0"),
        ("vehicle.driveline_efficiency = '0.9'", "vehicle.driveline_efficiency", "str"),
        ("kinematics.maximum_lag_s = 2.1", "kinematics.maximum_lag_s", "<= 2.0"),
        ("window.samples = 599", "window.samples", ">= 600"),
        ("window.samples = 1e5", "window.samples", "float"),
        ("window.hours = 1979-05-27", "window.hours", "date"),
        ("sampler.chains = 1", "sampler.chains", ">= 2"),
        ("sampler.seed = -1", "sampler.seed", ">= 0"),
        ("sampler.seed = true", "sampler.seed", "bool"),
        ("publish.source_address = 254", "publish.source_address", "<= 253"),
        ("publish.priority = 8", "publish.priority", "<= 7"),
        ("publish.cvw = 1", "publish.cvw", "int"),
        ("bus.match = 'both'", "bus.match", "both"),
        ("bus.dbc = 'a.dbc'", "bus.dbc", "array"),
        ("bus.dbc = ['a.dbc', 1]", "bus.dbc[1]", "int"),
        ("bus.source_addresses = {EEC1 = 0, CCVS1 = 300}", "bus.source_addresses.CCVS1", "<= 253"),
        ("signals.speed = 'A.b'\nsignals.grade = 3", "signals.grade", "int"),
        ("signals.wheel_speeds = ['A.b', 3]", "signals.wheel_speeds[1]", "int"),
        ("signals.velocity = 'A.b'", "signals.velocity", "wheel_speeds"),
        ("signals.speed = ['A.b']", "signals.speed", "only wheel_speeds"),
        ("signals.wheel_speeds = []", "signals.wheel_speeds", "empty"),
        ("signals.speed = ''", "signals.speed", "empty"),
        ("signals.speed = 'A'", "signals.speed", "MESSAGE.signal"),
        ("signals.speed = 'A.b.c'", "signals.speed", "MESSAGE.signal"),
        ("signals.speed = '.b'", "signals.speed", "MESSAGE.signal"),
        ("signals.wheel_speeds = ['A.b', 'A.']", "signals.wheel_speeds", "'A.'"),
    ],
)
def test_refused(tmp_path: Path, text: str, key: str, said: str) -> None:
    message = refusal(write(tmp_path, text))
    assert message.startswith(f"{key}: ")
    assert said in message.removeprefix(key)


@pytest.mark.parametrize(
    "text",
    ["[bus", "a = 1\na = 2", b"\xff\xfe", b"\0", "a = " + "9" * 5000, "a = " + "[" * 5000, "\x7fELF"],
    ids=["broken", "twice", "not UTF-8", "binary", "endless number", "deep", "program"],
)
def test_malformed(tmp_path: Path, text: str | bytes) -> None:
    assert refusal(write(tmp_path, text)).startswith("not valid TOML: ")


def test_a_mark_of_the_byte_order_before_the_first_line_is_no_part_of_it(tmp_path: Path) -> None:
    path = write(tmp_path, "\N{ZERO WIDTH NO-BREAK SPACE}[vehicle]\r\ndriveline_efficiency = 0.9\r\n")
    assert load(path).vehicle.driveline_efficiency == 0.9


def test_no_such_file_and_a_folder(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none.toml") == "No such file or directory; roadload init writes one"
    assert refusal(tmp_path) == "Is a directory"


def test_a_list_of_wheel_speeds_is_taken() -> None:
    config = from_dict({"signals": {"wheel_speeds": ["A.b", "A.c"]}})
    assert config.binding == {"wheel_speeds": ["A.b", "A.c"]}
    assert math.isfinite(config.window.hours)


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        ({"gate": {"minimum_samples": 5000}, "window": {"samples": 4000}}, "never fit into window.samples = 4000"),
        ({"lake": {"ranges": {"CCVS1.WheelBasedVehicleSpeed": [5, 1]}}}, "5.0 is not below 1.0"),
    ],
)
def test_settings_that_leave_nothing_are_refused(tables: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        from_dict(tables)
