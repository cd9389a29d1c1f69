"""Frames to SI values: any layout gives what cantools gives; sources, specials, short frames; batches do not matter."""

from collections import Counter
from pathlib import Path

import cantools
import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from truck_frames import BROADCAST, LARGE, SPEED, TORQUE, TRUCK, announced, broadcast, cut, pack

from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import EXTENDED, Frames
from estimator.config import from_dict
from estimator.signals import Floats, Role
from estimator.units import conversion_of

# One signal a role, so that every signal has a series of its own.
UNITS = {
    "speed": ("m/s", "km/h", "mph"),
    "engine_torque": ("Nm", "lb-ft"),
    "ambient_temperature": ("degC", "K", "degF"),
    "air_pressure": ("kPa", "mbar"),
    "engine_speed": ("rpm", "deg/s"),
    "gear": ("",),
}
SEEDED = settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))

Result = tuple[dict[Role, tuple[Floats, Floats]], dict[str, int], int, dict[str, int]]


def decode(config: dict, database: Database, batches: list[Frames]) -> Result:
    """Everything that decoding leaves: series, what was rejected, frames used, sources."""
    settings = from_dict(config)
    decoder = Decoder(bind(settings, database), settings.bus)
    parts: dict[Role, list] = {}
    for batch in batches:
        for role, series in decoder.decode(batch).items():
            assert len(series) == 1
            parts.setdefault(role, []).append(series[0])
    joined = {
        role: (np.concatenate([s.t for s in series]), np.concatenate([s.value for s in series]))
        for role, series in parts.items()
    }
    return joined, dict(decoder.rejected + decoder.transport_rejected), decoder.used, decoder.sources


def assert_same(one: Result, other: Result) -> None:
    assert one[1:] == other[1:]
    assert one[0].keys() == other[0].keys()
    for role in one[0]:
        np.testing.assert_array_equal(one[0][role], other[0][role])


def series(result: Result, role: str) -> list[float | None]:
    return [None if np.isnan(v) else float(v) for v in result[0][Role(role)][1]] if Role(role) in result[0] else []


# --- Against cantools ---------------------------------------------------------------------------------------------


@st.composite
def layouts(draw: st.DrawFn) -> tuple[Database, list[str]]:
    """One message of random layout, and the names of its signals, which are roles."""
    extended = draw(st.booleans())
    size = draw(st.sampled_from([1, 2, 3, 5, 8, 8, 8, 12, 24, 64]))
    depth = draw(st.integers(0, 2)) if size >= 3 else 0
    signals = []
    for level, name in enumerate(["Outer", "Inner"][:depth]):
        parent = "Outer" if level else None
        ids = draw(st.lists(st.integers(0, 7), min_size=1, unique=True)) if parent else None
        start, order = (level * 8, "little_endian") if draw(st.booleans()) else (level * 8 + 2, "big_endian")
        signals.append(
            Signal(name, start, 3, order, is_multiplexer=True, multiplexer_ids=ids, multiplexer_signal=parent)
        )
        # cantools refuses a frame whose multiplexer selects nothing, so something is there for every value.
        signals.append(Signal(f"{name}Any", 16, 1, multiplexer_ids=list(range(8)), multiplexer_signal=name))
    taken = set(range(8 * min(size, 3) if depth else 0))
    roles = []
    for role in draw(st.lists(st.sampled_from(sorted(UNITS)), min_size=1, max_size=4, unique=True)):
        parent = draw(st.sampled_from([None, "Outer", "Inner"][: depth + 1]))
        is_float = size >= 4 and draw(st.integers(0, 3)) == 0
        length = draw(st.sampled_from([32, 64][: size // 4])) if is_float else draw(st.integers(1, min(64, 8 * size)))
        first = draw(st.integers(0, 8 * size - length))  # counted from the top bit of the first byte if big-endian
        big = draw(st.booleans())
        # As bits in the order of the frame; cantools does not decode signals that overlap.
        bits = {b if big else b // 8 * 8 + 7 - b % 8 for b in range(first, first + length)}
        if bits & taken:
            continue
        taken |= bits
        roles.append(role)
        scale = draw(st.sampled_from([1, 0.5, 0.125, 1 / 256, -2, 1e-3, 3.7]))
        signals.append(
            Signal(
                role,
                first // 8 * 8 + 7 - first % 8 if big else first,
                length,
                "big_endian" if big else "little_endian",
                draw(st.booleans()),
                conversion=BaseConversion.factory(scale, draw(st.sampled_from([0, -125, 1000.5])), is_float=is_float),
                unit=draw(st.sampled_from(UNITS[role])),
                multiplexer_ids=draw(st.lists(st.integers(0, 7), min_size=1, unique=True)) if parent else None,
                multiplexer_signal=parent,
            )
        )
    assume(roles)
    ident = draw(st.integers(0, (1 << 29 if extended else 1 << 11) - 1))
    message = Message(ident, "M", size, signals, is_extended_frame=extended, strict=False)
    return Database([message], strict=False), roles


@pytest.mark.slow
@SEEDED
@given(layouts(), st.integers(0, 2**32), st.lists(st.integers(0, 60), max_size=4), st.booleans())
def test_any_layout_decodes_as_cantools_does(
    tmp_path: Path, layout: tuple[Database, list[str]], seed: int, places: list[int], through_text: bool
) -> None:
    database, roles = layout
    if through_text:
        (tmp_path / "layout.dbc").write_text(database.as_dbc_string(), "cp1252", newline="")
        database = load_database([str(tmp_path / "layout.dbc")])
    message = database.get_message_by_name("M")
    rng = np.random.default_rng(seed)
    width = 8 if message.length <= 8 else 64
    n = 40
    data = np.zeros((n, width), np.uint8)
    data[:, : message.length] = rng.choice([0, 255, 128, -1], (n, message.length), p=[0.1, 0.1, 0.1, 0.7])
    noise = rng.integers(0, 256, data.shape, dtype=np.uint8)
    data[:, : message.length] = np.where(
        rng.random((n, message.length)) < 0.7, noise[:, : message.length], data[:, : message.length]
    )
    key = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
    ident = np.full(n, key, np.uint32)
    stray = rng.random(n) < 0.2
    ident[stray] ^= rng.choice([1, EXTENDED, 1 << 8], stray.sum()).astype(np.uint32)
    frames = Frames(np.arange(n) * 0.1, ident, np.full(n, message.length, np.uint8), data)

    config = {"signals": {role: f"M.{role}" for role in roles}}
    # Few enough at a time that no sender is judged: random values are no vehicle's.
    few = list(range(0, n, 5))
    result = decode(config, database, cut(frames, few))
    assert_same(result, decode(config, database, cut(frames, [*few, *places])))

    expected: dict[str, list[tuple[float, float]]] = {}
    for t, row in zip(frames.t[~stray], data[~stray], strict=True):
        for name, value in message.decode(row[: message.length].tobytes(), decode_choices=False).items():
            if name in roles:
                unit = conversion_of(message.get_signal_by_name(name).unit)
                with np.errstate(over="ignore", invalid="ignore"):
                    si = np.float64(value) * unit.scale + unit.offset if unit else np.float64(value)
                is_number = np.abs(si) <= np.finfo(np.float32).max  # not where it is infinite or no number
                expected.setdefault(name, []).append((t, si if is_number else np.nan))
    assert result[0].keys() == expected.keys()
    for name, pairs in expected.items():
        np.testing.assert_array_equal(result[0][Role(name)][0], [t for t, _ in pairs])
        np.testing.assert_allclose(result[0][Role(name)][1], [v for _, v in pairs], rtol=1e-9, atol=1e-9)


# --- By whole id --------------------------------------------------------------------------------------------------

CAR = cantools.database.load_string(
    """VERSION ""
BS_:
BU_: X
BO_ 256 CAR: 8 X
 SG_ Multiplexer M : 56|8@1+ (1,0) [0|0] "" X
 SG_ Speed m1 : 0|16@1+ (0.01,0) [0|250] "km/h" X
 SG_ Power : 16|8@1- (1,0) [0|0] "kW" X
BO_ 257 SLOPE: 8 X
 SG_ Angle : 0|8@1- (1,0) [0|0] "deg" X
 SG_ Real : 8|32@1- (1,0) [-10|10] "m" X
BO_ 258 LONG: 64 X
 SG_ Speed : 504|8@1+ (1,0) [0|0] "m/s" X
BO_ 2566844926 J: 8 X
 SG_ Speed : 8|16@1+ (0.00390625,0) [0|0] "km/h" X
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2566844926 3;
SIG_VALTYPE_ 257 Real : 1;
""",
    database_format="dbc",
)


def test_short_frames_are_rejected_whole_even_if_only_the_multiplexer_is_cut_off() -> None:
    frames = pack((0, 256, "1027 05"), (1, 256, "1027 05 00 00 00 00"), (2, 256, "1027 05 00 00 00 00 01"))
    result = decode({"signals": {"speed": "CAR.Speed"}}, CAR, [frames])
    assert series(result, "speed") == pytest.approx([100 / 3.6])
    assert result[1:3] == ({"CAR: short frame": 2}, 1)


@pytest.mark.parametrize("name", ["CAR.Speed", "LONG.Speed"])
def test_a_batch_of_nothing_but_short_frames(name: str) -> None:
    frames = pack((0, 256, ""), (1, 258, "00"))
    result = decode({"signals": {"speed": name}}, CAR, [frames])
    assert result[0] == {}
    assert result[1:3] == ({f"{name.split('.')[0]}: short frame": 1}, 0)


def test_out_of_range_becomes_nan_with_half_a_bit_of_room() -> None:
    raw = [0, 25000, 25001, 65535]
    frames = pack(*((float(i), 256, r.to_bytes(2, "little") + bytes(5) + b"\1") for i, r in enumerate(raw)))
    result = decode({"signals": {"speed": "CAR.Speed"}}, CAR, [frames])
    assert series(result, "speed") == pytest.approx([0, 250 / 3.6, None, None])
    assert result[1] == {"CAR.Speed: out of range": 2}


def test_floating_point_signals_may_hold_anything() -> None:
    values = [1.5, np.nan, np.inf, -np.inf, 11.5, 3e38]
    rows = [b"\0" + np.float32(v).tobytes() + bytes(3) for v in values] + [bytes.fromhex("00 010080 7f 000000")]
    result = decode({"signals": {"altitude": "SLOPE.Real"}}, CAR, [pack(*((0.0, 257, row) for row in rows))])
    assert series(result, "altitude") == [1.5, *[None] * 6]
    assert result[1] == {"SLOPE.Real: not a number": 4, "SLOPE.Real: out of range": 2}


def test_a_slope_given_as_an_angle_becomes_its_tangent() -> None:
    result = decode({"signals": {"grade": "SLOPE.Angle"}}, CAR, [pack((0, 257, "05" * 8), (1, 257, "fb" * 8))])
    np.testing.assert_allclose(series(result, "grade"), np.tan(np.radians([5, -5])))


def test_ids_of_11_and_29_bits_are_told_apart_and_no_value_is_special() -> None:
    frames = pack((0, 256, "ffff ff 00 00 00 00 00"), (1, 257, bytes(8)))
    same_number = Frames(frames.t, frames.ident | EXTENDED, frames.length, frames.data)
    config = {"signals": {"engine_power": "CAR.Power"}}
    assert series(decode(config, CAR, [frames]), "engine_power") == [-1000]
    assert decode(config, CAR, [same_number, pack()]) == ({}, {}, 0, {})


def test_j1939_values_that_are_none_stay_so_when_matched_by_whole_id() -> None:
    ident = 2566844926 & 0x1FFFFFFF
    frames = pack((0, ident, "ff 00 10 ff ff ff ff ff"), (1, ident, "ff" * 8), (2, ident ^ 1, "00" * 8))
    result = decode({"bus": {"match": "id"}, "signals": {"speed": "J.Speed"}}, CAR, [frames])
    assert series(result, "speed") == pytest.approx([16 / 3.6, None])
    assert result[1] == {"J.Speed: not available": 1}
    assert result[3] == {}


# --- J1939 --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(st.integers(0, 7), st.integers(0, 255), st.integers(0, 255))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_matched_by_pgn_whatever_priority_source_and_destination(priority: int, source: int, low: int) -> None:
    distance = {"signals": {"altitude": "ADDRESSED.Distance"}}
    pdu1 = priority << 26 | 0x00DF0000 | low << 8 | source
    assert series(decode(distance, TRUCK, [pack((0, pdu1, "07" + "00" * 7))]), "altitude") == [7]
    pdu2 = priority << 26 | 0x00FE0000 | low << 8 | source
    found = decode(SPEED, TRUCK, [pack((0, pdu2, "00" * 8))])
    assert series(found, "speed") == ([0] if low == 0xF1 else [])
    other_page = pdu1 | 1 << 24, pdu2 | 1 << 24
    for ident in other_page:
        assert decode(SPEED | distance, TRUCK, [pack((0, ident, "00" * 8))]) == ({}, {}, 0, {})


@pytest.mark.parametrize(
    ("role", "name", "place", "codes"),
    [
        ("brake_switch", "Switch", (3, 4), {0: 0, 1: 1, 2: "error", 3: "not available"}),
        ("gear", "Gear", (4, 0), {0: 0, 13: 13, 14: "error", 15: "not available"}),
        (
            "brake_pedal",
            "Fraction",
            (0, 0),
            {0: 0, 250: 2.5, 251: "reserved value", 253: "reserved value", 254: "error", 255: "not available"},
        ),
        (
            "speed",
            "Speed",
            (1, 0),
            {
                0xFAFF: 0xFAFF / 256 / 3.6,
                0xFB00: "reserved value",
                0xFDFF: "reserved value",
                0xFE00: "error",
                0xFEFF: "error",
                0xFF00: "not available",
                0xFFFF: "not available",
            },
        ),
        # Two's complement leaves no room for special values: -1 is all ones.
        ("engine_torque", "Signed", (5, 0), {0xFFFF: -1, 0xFB00: -1280, 0x8000: -32768}),
    ],
)
def test_special_values(role: str, name: str, place: tuple[int, int], codes: dict[int, float | str]) -> None:
    rows = [(0.0, BROADCAST, bytes(8))]
    for k, code in enumerate(codes):
        rows.append((k + 1.0, BROADCAST, (code << 8 * place[0] + place[1]).to_bytes(8, "little")))
    result = decode({"signals": {role: f"BROADCAST.{name}"}}, TRUCK, [pack(*rows)])
    assert series(result, role) == pytest.approx([0, *(None if isinstance(v, str) else v for v in codes.values())])
    reasons = Counter(v for v in codes.values() if isinstance(v, str))
    assert result[1] == {f"BROADCAST.{name}: {reason}": count for reason, count in reasons.items()}
    assert result[2] == len(rows)


def test_32_bit_special_values() -> None:
    raw = [0xFAFFFFFF, 0xFB000000, 0xFDFFFFFF, 0xFE000000, 0xFF000000, 0xFFFFFFFF]
    rows = [(float(k), 0x18DFFF03, r.to_bytes(4, "little") + bytes(4)) for k, r in enumerate(raw)]
    result = decode({"signals": {"altitude": "ADDRESSED.Distance"}}, TRUCK, [pack(*rows)])
    assert series(result, "altitude") == [0xFAFFFFFF, *[None] * 5]
    path = "ADDRESSED.Distance"
    assert result[1] == {f"{path}: reserved value": 2, f"{path}: error": 1, f"{path}: not available": 2}


def test_signals_of_one_message_may_come_from_different_sources() -> None:
    frames = pack(broadcast(0, 1, 25600), broadcast(1, 2, 0xFFFF, switch=1), broadcast(2, 3, 256, switch=0))
    config = {"signals": {"speed": "BROADCAST.Speed", "brake_switch": "BROADCAST.Switch"}}
    result = decode(config, TRUCK, [frames])
    assert series(result, "speed") == pytest.approx([100 / 3.6])
    assert series(result, "brake_switch") == [1]
    assert result[1:] == (
        {"BROADCAST: other source address": 1},
        2,
        {"BROADCAST.Speed": 1, "BROADCAST.Switch": 2},
    )


def test_the_configured_source_wins() -> None:
    frames = pack(broadcast(0, 1, 25600), broadcast(1, 2, 0xFFFF), broadcast(2, 2, 256))
    result = decode(SPEED | {"bus": {"source_addresses": {"BROADCAST": 2}}}, TRUCK, [frames])
    assert series(result, "speed") == pytest.approx([None, 1 / 3.6])
    assert result[1] == {"BROADCAST: other source address": 1, "BROADCAST.Speed: not available": 1}


def test_short_long_and_unknown_frames_leave_the_others_alone() -> None:
    frames = pack(
        (0, BROADCAST, "ff 00"),
        (1, BROADCAST, "ff 00 64"),  # carries all that is wanted
        (2, BROADCAST, ""),
        (3, BROADCAST, "ff 00 32" + "ff" * 61),
        (4, 0x123, "00" * 8),
        (5, 0x18FEF200, "00" * 8),
        (6, 0x7F1, ""),
    )
    result = decode(SPEED, TRUCK, [frames])
    assert series(result, "speed") == pytest.approx([100 / 3.6, 50 / 3.6])
    assert result[1:3] == ({"BROADCAST: short frame": 2}, 2)


@pytest.mark.parametrize("size", [21, 28, 34, 39, 40, 300])
def test_a_multi_packet_broadcast_of_any_length_that_carries_the_signal(size: int) -> None:
    payload = bytearray(b"\xff" * size)
    payload[19:21] = (2500).to_bytes(2, "little")
    frames = pack(*announced(10.0, 0, LARGE, bytes(payload)))
    result = decode(TORQUE, TRUCK, [frames])
    assert series(result, "reference_torque") == [2500]
    assert result[0][Role.REFERENCE_TORQUE][0][0] == frames.t[-1]
    for k in range(1, len(frames)):
        assert_same(result, decode(TORQUE, TRUCK, cut(frames, [k])))


def test_a_signal_behind_byte_255_of_a_broadcast_is_decoded() -> None:
    text = 'BO_ 2566841342 LONG: 400 X\n SG_ Torque : 2032|16@1+ (1,0) [0|0] "Nm" X\n'
    text += 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
    text += 'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\nBA_ "VFrameFormat" BO_ 2566841342 3;\n'
    database = cantools.database.load_string(text, database_format="dbc")
    payload = bytearray(b"\xff" * 400)
    payload[254:256] = (2500).to_bytes(2, "little")
    bound = {"signals": {"reference_torque": "LONG.Torque"}}
    found = decode(bound, database, [pack(*announced(0, 0, LARGE, bytes(payload)))])
    assert series(found, "reference_torque") == [2500]
    short = decode(bound, database, [pack(*announced(0, 0, LARGE, bytes(payload[:255])))])
    assert short[:2] == ({}, {"LONG: short frame": 1})


def test_a_multi_packet_broadcast_too_short_for_the_signal() -> None:
    frames = pack(*announced(0, 0, LARGE, bytes(20)))
    assert decode(TORQUE, TRUCK, [frames])[:2] == ({}, {"LARGE: short frame": 1})


def test_a_group_sent_in_one_long_frame_or_in_packets_is_the_same_group() -> None:
    payload = bytes(range(39))
    frames = pack((0, 0x18FEE300, payload), *announced(1, 0, LARGE, payload), (2, 0x18FEE300, payload))
    result = decode(TORQUE, TRUCK, [frames])
    assert series(result, "reference_torque") == [0x1413] * 3
    assert np.all(np.diff(result[0][Role.REFERENCE_TORQUE][0]) > 0)
    rows = announced(0, 0, 0xFEF1, bytes([0xFF, 0, 100, *[0xFF] * 6]))
    assert series(decode(SPEED, TRUCK, [pack(*rows)]), "speed") == pytest.approx([100 / 3.6])


def test_a_signal_that_does_not_fit_its_message_is_counted_and_not_an_error() -> None:
    database = cantools.database.load_string(
        TRUCK.as_dbc_string().replace("LARGE: 39", "LARGE: 20"), database_format="dbc", strict=False
    )
    rows = [(0.0, 0x18FEE300, bytes(8)), *announced(1, 0, LARGE, bytes(19) + b"\x01\x02" + bytes(9))]
    result = decode(TORQUE, database, [pack(*rows)])
    assert series(result, "reference_torque") == [0x0201]
    assert result[1] == {"LARGE: short frame": 1}


@pytest.mark.slow
@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([BROADCAST, BROADCAST | 1, 0x1CECFF00, 0x1CEBFF00, 0x18DF0000, 0x18FEE300, 256, 258])
            | st.integers(0, (1 << 29) - 1),
            st.binary(max_size=8) | st.binary(min_size=64, max_size=64),
        ),
        max_size=20,
    )
)
def test_arbitrary_frames_never_raise(rows: list[tuple[int, bytes]]) -> None:
    names = {"speed": "BROADCAST.Speed", "reference_torque": "LARGE.Torque", "altitude": "ADDRESSED.Distance"}
    frames = pack(*((float(i), *row) for i, row in enumerate(rows)))
    decode({"signals": names}, TRUCK, [frames])
    decode({"signals": {"speed": "CAR.Speed", "altitude": "SLOPE.Real"}}, CAR, [frames])
    back = Frames.from_messages(frames.messages())
    for name in Frames.__slots__:
        np.testing.assert_array_equal(getattr(back, name), getattr(frames, name))
