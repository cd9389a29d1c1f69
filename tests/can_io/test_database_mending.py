"""Databases as people have them: what cannot be used is left out and counted, and the rest is read."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from project_paths import TESTS

from estimator.can_io.binding import VehicleDatabase, bind, load_database
from estimator.can_io.database_mending import mend, mended_name
from estimator.config import from_dict

CASES = TESTS / "databases"
CAR = """VERSION ""

NS_ :
\tCM_
\tBA_DEF_
\tVAL_

BS_:

BU_: ECU

BO_ 256 CAR: 8 ECU
 SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" ECU
 SG_ Brake : 16|2@1+ (1,0) [0|3] "" ECU

BO_ 2566844926 CCVS1: 8 ECU
 SG_ WheelSpeed : 8|16@1+ (0.00390625,0) [0|250.996] "km/h" ECU

BO_ 512 MUX: 8 ECU
 SG_ Selector M : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ Temperature m1 : 8|8@1- (1,-40) [0|0] "deg C" ECU
 SG_ Torque m2 : 8|16@0- (0.5,0) [0|0] "Nm" ECU

CM_ "of the bus";
CM_ SG_ 256 Speed "of the wheels,
 SG_ Fake : 0|8@1+ (1,0) [0|0] \\"x\\" X
BO_ in a text";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "GenMsgCycleTime" BO_ 256 20;
BA_ "VFrameFormat" BO_ 2566844926 3;
VAL_ 256 Brake 0 "Released" 1 "Pressed" 2 "Error" 3 "N/A" ;
"""


def load(folder: Path, text: str | bytes) -> VehicleDatabase:
    path = folder / "car.dbc"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_database([str(path)])


def described(database: VehicleDatabase) -> dict[tuple[str, str], tuple]:
    """All that decoding needs of each signal."""
    return {
        (m.name, s.name): (
            *(m.frame_id, m.is_extended_frame, m.length, m.cycle_time or None, m.protocol),
            *(s.start, s.length, s.byte_order, s.is_signed, s.is_float, s.scale, s.offset, s.minimum, s.maximum),
            *(s.unit, s.multiplexer_signal, tuple(s.multiplexer_ids or ()), s.is_multiplexer),
            tuple((value, str(text)) for value, text in (s.choices or {}).items()),
        )
        for m in database.messages
        for s in m.signals
    }


def test_a_database_without_errors_is_read_as_it_is(tmp_path: Path) -> None:
    database = load(tmp_path, CAR)
    assert database.remarks == ()
    assert len(described(database)) == 6
    (cycle,) = {m.cycle_time for m in database.messages if m.name == "CAR"}
    assert cycle == 20
    assert database.get_message_by_name("CCVS1").protocol == "j1939"
    speed = database.get_message_by_name("CAR").get_signal_by_name("Speed")
    assert speed.comment is not None
    assert speed.comment.startswith("of the wheels")
    torque = database.get_message_by_name("MUX").get_signal_by_name("Torque")
    assert (torque.multiplexer_signal, torque.multiplexer_ids) == ("Selector", [2])


@pytest.mark.parametrize(
    ("name", "remark", "signals"),
    [
        ("unused_val", "value tables of signals that do not exist (2, first in line 8)", 4),
        ("dbc_comment_of_no_signal", "comments that cannot be read (1, line 12)", 3),
        ("id_beyond_11_bits", "11-bit identifiers that need 29 bits are read as 29-bit ones (1, line 3)", 2),
        ("name_with_digit", "names that begin with a digit or have other signs are mended (1, line 4)", 4),
        ("dbc_multiplexer_with_long_name", "", 3),
        ("units_unit_names", "", 3),
    ],
)
def test_cases_that_cantools_refuses(name: str, remark: str, signals: int) -> None:
    database = load_database([str(CASES / f"{name}.dbc")])
    assert sum(len(message.signals) for message in database.messages) == signals
    assert len(database.remarks) == bool(remark)
    assert all(line.startswith(f"{CASES / name}.dbc: ") and remark in line for line in database.remarks)


def bound_names(path: Path, signals: dict[str, str]) -> list[str]:
    messages = bind(from_dict({"signals": signals}), load_database([str(path)]))
    return [f"{m.name}.{s.signal.name}" for m in messages for s in m.signals]


@pytest.mark.parametrize("name", ["4WD_Speed", "_4WD_Speed"])
def test_a_mended_name_and_that_of_the_file_bind(name: str) -> None:
    assert bound_names(CASES / "name_with_digit.dbc", {"speed": f"MOTION.{name}"}) == ["MOTION._4WD_Speed"]


@pytest.mark.parametrize(
    "name", ["PowertrainSelectorOfTheVehicleLongName", "PowertrainSelectorOfTheVehicleLo"], ids=["long", "short"]
)
def test_long_and_short_names_bind(name: str) -> None:
    path = CASES / "dbc_multiplexer_with_long_name.dbc"
    assert bound_names(path, {"gear": f"CAR.{name}"}) == ["CAR.PowertrainSelectorOfTheVehicleLongName"]
    (message,) = bind(from_dict({"signals": {"speed": "CAR.Speed"}}), load_database([str(path)]))
    assert [multiplexer.start for multiplexer in message.signals[0].multiplexers] == [0]


def test_frames_of_more_than_11_bits_are_bound_by_29() -> None:
    database = load_database([str(CASES / "id_beyond_11_bits.dbc")])
    (message,) = bind(from_dict({"signals": {"speed": "WHEELS.Speed"}}), database)
    assert message.key == 1 << 31 | 2560


EXTRA = [  # statements that no tool can use, and the kind that they are counted as
    ('VAL_ 256 Gear 0 "P" 1 "D" ;', "value tables of signals that do not exist"),
    ('VAL_ 999 Speed 0 "P" ;', "value tables of signals that do not exist"),
    ('VAL_ 256 Brake 0 "P', "value tables that cannot be read"),
    ('CM_ SG_ 256 Gear "lever";', "comments of signals that do not exist"),
    ('CM_ SG_ 256 "of no signal";', "comments that cannot be read"),
    ('CM_ BO_ 999 "of no message";', "comments of messages that do not exist"),
    ('CM_ SG_ 256 Speed "not ended;', "comments that cannot be read"),
    ('BA_ "GenSigStartValue" SG_ 256 Gear 0;', "attributes of signals that do not exist"),
    ('BA_ "GenMsgCycleTime" BO_ 999 100;', "attributes of messages that do not exist"),
    ("SIG_VALTYPE_ 256 Gear : 1;", "types of signals that do not exist"),
    ("SG_MUL_VAL_ 512 Gear Selector 3-3;", "multiplexed signals that do not exist"),
    ("SG_MUL_VAL_ 512 Torque Selector 0-4000000000;", "multiplexers that select a signal by more than 4,096 values"),
    ("BO_ 4294967295 TOO_LONG: 8 ECU", "messages whose identifier has more than 29 bits"),
    ("BO_ 300 HUGE: 4000000000 ECU", "messages of more than 65,536 bytes"),
    ("BO_ 300: 8 ECU", "messages that cannot be read"),
    ("BO_ 256 CAR: 8 ECU", "messages that are defined twice"),
    ("this is no statement", "lines that are no statement of a DBC"),
    ("BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 Vector__XXX", ""),
    ('VAL_ Environment 0 "off" 1 "on" ;', ""),
    ('EV_ Environment: 0 [0|1] "" 0 1 DUMMY_NODE_VECTOR0 ECU;', ""),
    ("SIG_GROUP_ 999 Group 1 : Speed;", ""),
    ("// a remark", ""),
    ("/* a remark\nof two lines */", ""),
]
EXTRA_SIGNALS = [
    (' SG_ Speed : 40|8@1+ (1,0) [0|0] "" ECU', "signals that are defined twice in their message"),
    (' SG_ Empty : 40|0@1+ (1,0) [0|0] "" ECU', "signals of no bit, or beyond the end of any message"),
    (' SG_ Far : 2000000000|8@1+ (1,0) [0|0] "" ECU', "signals of no bit, or beyond the end of any message"),
    (' SG_ Broken : 40|8 (1,0) [0|0] "" ECU', "signals that cannot be read"),
    (' SG_ Lost m4 : 40|8@1+ (1,0) [0|0] "" ECU', "multiplexed signals without a multiplexer"),
    (" SG_", ""),
]
MENDED_SIGNALS = [  # that are read all the same
    (' SG_ 4WD : 40|8@1+ (1,0) [0|0] "" ECU', "_4WD"),
    (' SG_ Rate-of.turn : 40|8@1+ (1,0) [0|0] "" ECU', "Rate_of_turn"),
    (' SG_ Point : 40|8@1+ (.5,-.25) [-.5|.5] "" ECU', "Point"),
    (" SG_ Short : 40|8@1+ (1,0)", "Short"),
    (' SG_ Spaced:40 | 8 @ 1 + ( 1 , 0 ) [ 0 | 0 ] "" ECU,', "Spaced"),
]


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 20), st.sampled_from(EXTRA)), min_size=1, max_size=12))
@settings(max_examples=80, deadline=None, derandomize=True)
def test_statements_that_cannot_be_used_leave_the_rest_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, additions: list[tuple[int, tuple[str, str]]]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = described(load(folder, CAR))
    # Between the statements, after the messages: what follows BO_ and SG_ belongs to them.
    head, tail = CAR.split('CM_ "of the bus";')
    lines = ['CM_ "of the bus";', *tail.split(";\n")]
    statements = [lines[0], *(f"{line.strip()};" for line in lines[1:] if line.strip())]
    for place, (addition, _) in additions:
        statements.insert(1 + place % len(statements), addition)
    database = load(folder, head + "\n".join(statements) + "\n")
    assert described(database) == whole
    said = " ".join(database.remarks)
    for _, (_, kind) in additions:
        assert kind in said
    assert bool(database.remarks) == any(kind for _, (_, kind) in additions)


@pytest.mark.slow
@given(st.lists(st.sampled_from(EXTRA_SIGNALS), min_size=1, max_size=4), st.sampled_from(["CAR", "CCVS1"]))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_signals_that_cannot_be_used_leave_the_rest_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, additions: list[tuple[str, str]], name: str
) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = described(load(folder, CAR))
    first = " SG_ Brake" if name == "CAR" else "\nBO_ 512"
    added = "\n".join(line.replace("Speed", "Speed" if name == "CAR" else "WheelSpeed") for line, _ in additions)
    database = load(folder, CAR.replace(first, f"{added}\n{first}", 1))
    assert described(database) == whole
    said = " ".join(database.remarks)
    assert all(kind in said for _, kind in additions)


@pytest.mark.parametrize(("line", "name"), MENDED_SIGNALS)
def test_signals_that_other_tools_read(tmp_path: Path, line: str, name: str) -> None:
    whole = described(load(tmp_path, CAR))
    database = load(tmp_path, CAR.replace(" SG_ Brake", f"{line}\n SG_ Brake", 1))
    assert described(database).items() >= whole.items()
    assert described(database)["CAR", name][5:7] == (40, 8)


@pytest.mark.slow
@given(st.lists(st.integers(0, 40), max_size=8))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_missing_semicolons_change_nothing(tmp_path_factory: pytest.TempPathFactory, places: list[int]) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = described(load(folder, CAR))
    parts = CAR.split(";\n")
    ends = ["\n" if i in places else ";\n" for i in range(len(parts) - 1)]
    database = load(folder, "".join(part + end for part, end in zip(parts, [*ends, ""], strict=True)))
    assert described(database) == whole
    assert database.remarks == ()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encodings_and_ends_of_lines(tmp_path: Path, encoding: str, newline: str) -> None:
    text = CAR.replace("of the bus", "für °C").replace("\n", newline)
    database = load(tmp_path, text.encode(encoding))
    assert described(database) == described(load(tmp_path, CAR))
    assert database.remarks == ()


def test_a_value_table_given_by_name_is_that_table(tmp_path: Path) -> None:
    text = CAR.replace('VAL_ 256 Brake 0 "Released" 1 "Pressed" 2 "Error" 3 "N/A" ;', "VAL_ 256 Brake States ;")
    database = load(tmp_path, text + 'VAL_TABLE_ States 0 "Released" 1 "Pressed" 2 "Error" 3 "N/A" ;\n')
    assert described(database) == described(load(tmp_path, CAR))


def test_a_multiplexer_that_is_left_out_takes_its_signals_along(tmp_path: Path) -> None:
    text = CAR.replace("SG_ Selector M : 0|8@1+", "SG_ Selector M : 0|0@1+")
    database = load(tmp_path, text)
    assert not any(name == "MUX" for name, _ in described(database))
    assert "multiplexed signals without a multiplexer (2, first in line 21)" in database.remarks[0]


@pytest.mark.parametrize("value", ["3", '"J1939PG"', "99", '"none"', "-1"])
def test_frame_formats_by_place_and_by_name(tmp_path: Path, value: str) -> None:
    database = load(tmp_path, CAR.replace("BO_ 2566844926 3;", f"BO_ 2566844926 {value};"))
    assert database.get_message_by_name("CCVS1").protocol == ("j1939" if value in ("3", '"J1939PG"') else None)


@pytest.mark.slow
@given(st.text(st.sampled_from('BO_SG_VAL_CM_ 256CAR:|@+()[],"\\;\n\t0'), max_size=200))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_anything_behind_a_message_leaves_it_readable(text: str) -> None:
    mended = mend(CAR + "\n" + text)
    assert "BO_ 256 CAR: 8" in mended.text
    assert " SG_ Speed : 0|16@1+ (0.01,0) [0|300]" in mended.text


@pytest.mark.slow
@given(st.text(min_size=1))
def test_mended_names_are_names(name: str) -> None:
    mended = mended_name(name)
    assert mended.isascii()
    assert mended.isidentifier()
    assert mended_name(mended) == mended


@pytest.mark.parametrize(
    "text",
    [
        "/*\n" * 20_000,
        'VAL_ 256 Brake 0 "a"' + " " * 200_000 + "x",
        "SG_MUL_VAL_ 512 Torque Selector " + "0-0 " * 20_000 + "x",
        'CM_ "\n' * 20_000,
        'CM_ SG_ 256 Speed "' + '\\"' * 20_000,
    ],
    ids=["comments", "blanks", "ranges", "quotes", "escapes"],
)
def test_texts_that_slow_patterns_would_never_end_on(text: str) -> None:
    assert "BO_ 256 CAR: 8" in mend(CAR + text).text
