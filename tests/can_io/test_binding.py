"""Databases and bindings: what cannot be bound is said in one line; units mean what they say."""

import contextlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import constants

from estimator.can_io.binding import BoundMessage, bind, load_database
from estimator.config import Config, from_dict
from estimator.errors import ConfigError, DatabaseError, InputError
from estimator.signals import Role
from estimator.units import KNOWN_UNITS, conversion_of, normal_form

HEAD = 'VERSION ""\nBS_:\nBU_: X\n'
CAR = """BO_ 256 CAR: 8 X
 SG_ Speed : 0|16@1+ (0.01,0) [0|250] "km/h" X
 SG_ Angle : 16|8@1- (1,0) [0|0] "deg" X
 SG_ Strange : 24|8@1+ (1,0) [0|0] "furlong/fortnight" X
 SG_ Bare : 32|8@1+ (1,0) [0|0] "" X
BO_ 2566844926 CCVS1: 8 X
 SG_ Speed : 8|16@1+ (0.00390625,0) [0|250] "km/h" X
BO_ 2364540158 EEC1: 8 X
 SG_ EngSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" X
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
BA_ "VFrameFormat" BO_ 2566844926 3;
"""


def dbc(folder: Path, text: str | bytes, name: str = "car.dbc") -> str:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(path)


def bound(folder: Path, config: dict, text: str | bytes = HEAD + CAR) -> list[BoundMessage]:
    return bind(from_dict(config), load_database([dbc(folder, text)]))


def refusal(kind: type[InputError], folder: Path, config: dict, text: str | bytes = HEAD + CAR) -> str:
    with pytest.raises(InputError) as caught:
        bound(folder, config, text)
    assert type(caught.value) is kind
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- Databases ----------------------------------------------------------------------------------------------------


def test_the_shipped_database_carries_the_default_binding() -> None:
    messages = bind(Config(), load_database([]))
    assert {s.role for m in messages for s in m.signals} == set(Config().binding)
    assert all(m.by_pgn and m.j1939 and m.source is None for m in messages)
    assert {m.name: m.key for m in messages}["EEC1"] == 0xF004


def test_several_files_are_one_database(tmp_path: Path) -> None:
    other = dbc(tmp_path, HEAD + 'BO_ 300 IMU: 8 X\n SG_ Yaw : 0|16@1- (1,0) [0|0] "rad/s" X\n', "imu.dbc")
    database = load_database([dbc(tmp_path, HEAD + CAR), other])
    messages = bind(from_dict({"signals": {"speed": "CAR.Speed", "yaw_rate": "IMU.Yaw"}}), database)
    assert [m.key for m in messages] == [256, 300]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "not a DBC"),
        ("The quick brown fox", "not a DBC"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "not a DBC"),
        (bytes(range(256)), "not a DBC"),
        (HEAD, "holds no CAN messages"),
        (
            HEAD + "BO_ 99999999999 CAR: 8 X\n",
            "holds no CAN messages; left out: messages that cannot be read (1, line 4)",
        ),
    ],
)
def test_what_is_no_database(tmp_path: Path, text: str | bytes, said: str) -> None:
    message = refusal(DatabaseError, tmp_path, {}, text)
    assert message.startswith(f"{tmp_path / 'car.dbc'}: ")
    assert said in message


def test_the_second_file_is_named_if_it_is_the_bad_one(tmp_path: Path) -> None:
    bad = dbc(tmp_path, "no", "bad.dbc")
    with pytest.raises(DatabaseError, match=r"^.*/bad\.dbc: not a DBC"):
        load_database([dbc(tmp_path, HEAD + CAR), bad])


def test_no_such_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match=r"none\.dbc: No such file or directory; .*--dbc"):
        load_database([str(tmp_path / "none.dbc")])
    with pytest.raises(DatabaseError, match=r"Is a directory; "):
        load_database([str(tmp_path)])


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(
    ("role", "unit"), [("ambient_temperature", "°C"), ("lateral_acceleration", "m/s²"), ("heading", "°")]
)
def test_units_with_signs_of_any_encoding(tmp_path: Path, encoding: str, role: str, unit: str) -> None:
    text = HEAD + f'BO_ 256 M: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "{unit}" X\nCM_ BO_ 256 "Größe, Übersicht";\n'
    (message,) = bound(tmp_path, {"signals": {role: "M.S"}}, text.encode(encoding))
    assert message.signals[0].conversion == conversion_of(unit) is not None


@pytest.mark.slow
@given(
    st.integers(0, len(CAR) - 1), st.sampled_from(['"', "|", "@", "-", " ", "", "99", "SG_", "\n", "é", "1e999", "nan"])
)
@settings(max_examples=150, deadline=None, derandomize=True)
def test_a_damaged_database_loads_or_is_refused(tmp_path_factory: pytest.TempPathFactory, k: int, put: str) -> None:
    config = {"signals": {"speed": "CAR.Speed", "engine_speed": "EEC1.EngSpeed"}}
    with contextlib.suppress(DatabaseError):
        bound(tmp_path_factory.getbasetemp(), config, HEAD + CAR[:k] + put + CAR[k + 1 :])


# --- Bindings -----------------------------------------------------------------------------------------------------


def test_unknown_message_names_the_nearest(tmp_path: Path) -> None:
    message = refusal(DatabaseError, tmp_path, {"signals": {"speed": "CCVS.Speed"}})
    assert message.startswith("signals.speed: the DBC has no message 'CCVS'; the nearest are CCVS1, ")


def test_unknown_signal_names_the_nearest(tmp_path: Path) -> None:
    message = refusal(DatabaseError, tmp_path, {"signals": {"wheel_speeds": ["CAR.Speed", "CAR.Sped"]}})
    assert message == "signals.wheel_speeds: message 'CAR' has no signal 'Sped'; did you mean Speed?"


def test_unknown_signal_lists_what_there_is_where_none_is_near(tmp_path: Path) -> None:
    message = refusal(DatabaseError, tmp_path, {"signals": {"speed": "CAR.xyz"}})
    assert message == "signals.speed: message 'CAR' has no signal 'xyz'; it has Speed, Angle, Strange, Bare"


def test_a_signal_that_was_left_out_is_said_to_be(tmp_path: Path) -> None:
    text = HEAD + CAR.replace("SG_ Bare : 32|8@1+", "SG_ Bare : 32|0@1+")
    message = refusal(DatabaseError, tmp_path, {"signals": {"gear": "CAR.Bare"}}, text)
    assert message.endswith("left out: signals of no bit, or beyond the end of any message (1, line 8)")


def test_all_wrong_units_are_named_in_one_message_with_the_line_that_mends_them(tmp_path: Path) -> None:
    signals = {"speed": "CAR.Strange", "engine_power": "CAR.Bare", "engine_speed": "CAR.Speed", "yaw_rate": "CAR.Angle"}
    message = refusal(DatabaseError, tmp_path, {"signals": signals})
    assert "CAR.Strange has the unknown unit 'furlong/fortnight' (speed takes km/h m/s mph " in message
    assert "CAR.Bare has no unit (engine_power takes kW W hp PS); " in message
    assert "CAR.Speed has the unit 'km/h', which does not fit (engine_speed takes rpm rad/s " in message
    line = message[message.index("[bus] ") :].removeprefix("[bus] ")
    units = tomllib.loads(line)["units"]
    (bound_message,) = bound(tmp_path, {"signals": signals, "bus": {"units": units | {"CAR.Angle": "deg/s"}}})
    assert len(bound_message.signals) == 4


def test_a_unit_of_the_configuration_counts_for_more_than_that_of_the_database(tmp_path: Path) -> None:
    config = {"signals": {"speed": "CAR.Speed"}, "bus": {"units": {"CAR.Speed": "mph"}}}
    (message,) = bound(tmp_path, config)
    assert message.signals[0].conversion == conversion_of("mph")


def test_a_range_of_the_configuration_counts_for_more_than_that_of_the_database(tmp_path: Path) -> None:
    config = {"signals": {"speed": "CAR.Speed"}, "bus": {"ranges": {"CAR.Speed": [-1, 400]}}}
    (message,) = bound(tmp_path, config)
    assert (message.signals[0].signal.minimum, message.signals[0].signal.maximum) == (-1, 400)


@pytest.mark.parametrize("table", ["units", "ranges", "states"])
def test_a_table_for_a_signal_that_is_not_bound(table: str, tmp_path: Path) -> None:
    value: object = {"units": "km/h", "ranges": [0, 1], "states": [1]}[table]
    config = {"signals": {"speed": "CAR.Speed"}, "bus": {table: {"CAR.Sped": value}}}
    message = refusal(ConfigError, tmp_path, config)
    assert message == f"bus.{table}.CAR.Sped: no signal of that name is bound; did you mean CAR.Speed?"


def test_states_of_what_is_no_switch(tmp_path: Path) -> None:
    config = {"signals": {"gear": "CAR.Bare"}, "bus": {"states": {"CAR.Bare": [1]}}}
    message = refusal(ConfigError, tmp_path, config)
    assert message == "bus.states.CAR.Bare: gear is no switch; take it out"


def test_states_need_no_unit_and_a_grade_may_be_an_angle(tmp_path: Path) -> None:
    (message,) = bound(tmp_path, {"signals": {"gear": "CAR.Strange", "brake_switch": "CAR.Bare", "grade": "CAR.Angle"}})
    assert [(s.role, s.conversion.scale, s.tangent) for s in message.signals] == [
        (Role.GEAR, 1.0, False),
        (Role.BRAKE_SWITCH, 1.0, False),
        (Role.GRADE, pytest.approx(np.pi / 180), True),
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('SG_ S : 0|65@1+ (1,0) [0|0] "" X', "M.S: a signal of 65 bits is no number"),
        ('SG_ S : 0|24@1+ (1,0) [0|0] "" X\nSIG_VALTYPE_ 256 S : 1;', "M.S: a floating-point signal of 24 bits"),
        (
            'SG_ S m0M : 0|8@1+ (1,0) [0|0] "" X\n SG_ T m0M : 8|8@1+ (1,0) [0|0] "" X\n'
            "SG_MUL_VAL_ 256 S T 0-0;\nSG_MUL_VAL_ 256 T S 0-0;",
            "M.S: T multiplexes itself",
        ),
    ],
)
def test_layouts_that_cannot_be_decoded(tmp_path: Path, line: str, said: str) -> None:
    text = f"{HEAD}BO_ 256 M: 64 X\n {line}\n"
    assert refusal(DatabaseError, tmp_path, {"signals": {"gear": "M.S"}}, text).startswith(said)


def test_source_address_of_a_message_that_is_not_bound(tmp_path: Path) -> None:
    config = {"bus": {"source_addresses": {"EEC1": 0}}, "signals": {"speed": "CCVS1.Speed"}}
    message = refusal(ConfigError, tmp_path, config)
    assert message == "bus.source_addresses.EEC1: no signal is bound to that message; bound are CCVS1"


@pytest.mark.parametrize(("name", "match"), [("CAR", "auto"), ("CCVS1", "id")])
def test_source_address_of_a_message_matched_by_its_whole_id(tmp_path: Path, name: str, match: str) -> None:
    config = {"bus": {"source_addresses": {name: 0}, "match": match}, "signals": {"speed": f"{name}.Speed"}}
    message = refusal(ConfigError, tmp_path, config)
    assert message == f"bus.source_addresses.{name}: matched by its whole id, not by PGN; leave it out"


def test_an_11_bit_id_cannot_be_matched_by_pgn(tmp_path: Path) -> None:
    message = refusal(ConfigError, tmp_path, {"bus": {"match": "pgn"}, "signals": {"speed": "CAR.Speed"}})
    assert message == 'bus.match: CAR has an 11-bit id, which holds no PGN; write "auto" or "id"'


@pytest.mark.parametrize(
    ("match", "name", "key", "by_pgn", "j1939"),
    [
        ("auto", "CCVS1", 0xFEF1, True, True),
        ("pgn", "CCVS1", 0xFEF1, True, True),
        ("id", "CCVS1", 2566844926, False, True),
        ("auto", "CAR", 256, False, False),  # the database says J1939, the id that it cannot be
        ("id", "CAR", 256, False, False),
    ],
)
def test_how_messages_are_matched(tmp_path: Path, match: str, name: str, key: int, by_pgn: bool, j1939: bool) -> None:
    config = {"bus": {"match": match}, "signals": {"speed": f"{name}.Speed"}}
    text = HEAD + CAR.replace('DEF_DEF_ "VFrameFormat" "J1939PG"', 'DEF_DEF_ "VFrameFormat" "StandardCAN"')
    for one in (HEAD + CAR, text):
        (message,) = bound(tmp_path, config, one)
        assert (message.key, message.by_pgn, message.j1939) == (key, by_pgn, j1939)


# --- Units --------------------------------------------------------------------------------------------------------

c = constants
SI = {
    "m/s mps meter/second Unit_MeterPerSecon meters/sec": 1,
    "km/h kph kmh kmph Unit_KiloMeterPerHour kilometer/hour km/hr [km/h]": c.kmh,
    "mph mi/h miles-per-hour": c.mph,
    "kt kts knots": c.knot,
    "ft/s fps": c.foot,
    "yd/s": c.yard,
    "m/s^2 m/s2 m/s² mps2 m/s/s m/sec^2 Unit_MeterPerSeconSquar m/s**2": 1,
    "g gn Unit_ForceOfGravi": c.g,
    "rad/s radians/sec rads/s": 1,
    "rpm 1/min r/min min^-1 u/min umin upm rev/min Unit_MinutInver angular_speed:rpm": 2 * c.pi / c.minute,
    "deg/s °/s º/s degree/s deg/sec grad/s Unit_DegreOfArcPerSecon degrees/second dps": c.degree,
    "r/s u/sec rps": 2 * c.pi,
    "nm NM n.m n·m n*m newton-meter Unit_NewtoMeter torque:N.m": 1,
    "knm": c.kilo,
    "cnm Unit_centiNewtoMeter": c.centi,
    "lbft lb-ft lbf.ft ft-lb ftlb ftlbf ft-lbs lbs-ft": c.lbf * c.foot,
    "w v a m kg pa rad 1 - ratio watts volts Amps ampere (V) meter kilogram kilograms kgrams Unit_KiloGram VDC ADC": 1,
    "kw km t kpa kv KiloPascal Unit_KiloWatt kilometer": c.kilo,
    "hp bhp": c.horsepower,
    "ps cv": 75 * c.kilogram_force,
    "% percent pct Unit_PerCent Percent (%)": c.centi,
    "deg ° degree degrees Unit_DegreOfArc angle:deg": c.degree,
    "mrad mm mv ma millimeter": c.milli,
    "cm": c.centi,
    "ft feet": c.foot,
    "mi mile": c.mile,
    "hpa mbar": c.hecto,
    "mpa": c.mega,
    "bar": c.bar,
    "psi": c.psi,
    "mmHg": c.mmHg,
    "lb lbs lbm": c.lb,
}
TEMPERATURES = {
    "degc °c ℃ Â°C deg.c celsius c deg_C Unit_DegreCelsi DegreesC temperature:C": "Celsius",
    "degf °f fahrenheit f": "Fahrenheit",
    "k kelvin degK °K": "Kelvin",
}


def test_every_spelling_converts_as_scipy_does() -> None:
    expected = {spelling: value for spellings, value in SI.items() for spelling in spellings.split()}
    scales = {spelling for spellings in TEMPERATURES for spelling in spellings.split()}
    tested = {normal_form(spelling) for spelling in expected.keys() | scales}
    assert tested >= {normal_form(spelling) for spelling in KNOWN_UNITS}
    for spelling, value in expected.items():
        unit = conversion_of(spelling)
        assert unit is not None, spelling
        assert unit.scale == pytest.approx(value, rel=1e-9), spelling
        assert unit.offset == 0
    for spellings, scale in TEMPERATURES.items():
        for spelling in spellings.split():
            unit = conversion_of(spelling)
            assert unit is not None, spelling
            for value in (-40.0, 0.0, 100.0):
                kelvin = c.convert_temperature(value, scale, "Kelvin")
                assert unit.scale * value + unit.offset == pytest.approx(kelvin, rel=1e-12), spelling


@pytest.mark.parametrize("spelling", ["km/h", "Km/H", " km / h ", "KM/H"])
def test_case_and_blanks_do_not_matter(spelling: str) -> None:
    assert conversion_of(spelling) == conversion_of("km/h") is not None


@pytest.mark.parametrize(
    "spelling",
    ["", None, "furlong", "km", "m/s m/s", "kph/mph", "km/h or MPH", "kN", "Unit_KiloNewto", "m/s^3", "Nm/s"],
)
def test_other_spellings_are_not_speeds(spelling: str | None) -> None:
    found = conversion_of(spelling)
    assert found is None or found.dimension != "m/s"
