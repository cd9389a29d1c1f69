"""Answers to a tester, joined from their frames while listening: layouts of makes, faults of a bus, any batches."""

import itertools
from collections.abc import Iterator

import can
import cantools
import numpy as np
import pytest
from cantools.database.can import Database
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.binding import bind
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.config import from_dict
from estimator.errors import DatabaseError
from estimator.signals import Role

Row = tuple[float, int, bytes]
PERIOD = 0.002  # s between frames of an answer

KONA = """VERSION ""
BU_: X
BO_ 2028 BMS: 62 X
 SG_ Current m257 : 103|16@0- (0.1,0) [0|0] "A" X
 SG_ Voltage m257 : 119|16@0+ (0.1,0) [0|0] "V" X
 SG_ Last m257 : 495|8@0+ (1,0) [0|0] "degC" X
 SG_ DID m98M : 15|16@0+ (1,0) [0|0] "" X
 SG_ Service M : 7|8@0+ (1,0) [0|0] "" X
BO_ 1979 CLU: 24 X
 SG_ Speed m256 : 39|8@0+ (1,0) [0|0] "km/h" X
 SG_ DID m98M : 15|16@0+ (1,0) [0|0] "" X
 SG_ Service M : 7|8@0+ (1,0) [0|0] "" X
SG_MUL_VAL_ 2028 Current DID 257-257;
SG_MUL_VAL_ 2028 Voltage DID 257-257;
SG_MUL_VAL_ 2028 Last DID 257-257;
SG_MUL_VAL_ 2028 DID Service 98-98;
SG_MUL_VAL_ 1979 Speed DID 256-256;
SG_MUL_VAL_ 1979 DID Service 98-98;
"""
KONA_ROLES = {
    "battery_current": "BMS.Current",
    "battery_voltage": "BMS.Voltage",
    "ambient_temperature": "BMS.Last",
    "speed": "CLU.Speed",
}
# The service comes second: the byte of the length stays in front, as in a single frame.
MEB = """VERSION ""
BU_: X
BO_ 2550005883 MEB: 16 X
 SG_ Voltage m7739 : 39|16@0+ (0.25,0) [0|0] "V" X
 SG_ Current m7741 : 47|24@0- (0.01,0) [0|0] "A" X
 SG_ DID m98M : 23|16@0+ (1,0) [0|0] "" X
 SG_ Service M : 15|8@0+ (1,0) [0|0] "" X
SG_MUL_VAL_ 2550005883 Voltage DID 7739-7739;
SG_MUL_VAL_ 2550005883 Current DID 7741-7741;
SG_MUL_VAL_ 2550005883 DID Service 98-98;
"""
MEB_ROLES = {"battery_voltage": "MEB.Voltage", "battery_current": "MEB.Current"}


def database(text: str) -> Database:
    found = cantools.database.load_string(text, database_format="dbc", strict=False)
    assert isinstance(found, Database)
    return found


def segments(t: float, ident: int, payload: bytes, *, pads: bool = True) -> Iterator[Row]:
    """The frames of an answer, as ISO 15765-2 cuts it."""
    if len(payload) < 8:
        rows = [bytes([len(payload)]) + payload]
    else:
        rows = [(0x1000 | len(payload)).to_bytes(2, "big") + payload[:6]]
        rest = [payload[k : k + 7] for k in range(6, len(payload), 7)]
        rows += [bytes([0x20 | (k + 1) % 16]) + part for k, part in enumerate(rest)]
    for k, data in enumerate(rows):
        yield t + PERIOD * k, ident, data.ljust(8, b"\xaa") if pads else data


def pack(rows: list[Row]) -> Frames:
    return Frames.from_messages(
        can.Message(timestamp=t, arbitration_id=ident, is_extended_id=ident > 0x7FF, data=data)
        for t, ident, data in rows
    )


def decoder_of(text: str, roles: dict[str, str]) -> Decoder:
    config = from_dict({"signals": roles})
    return Decoder(bind(config, database(text)), config.bus)


def decoded(decoder: Decoder, batches: list[list[Row]]) -> dict[str, list[tuple[float, float]]]:
    """Time and value of all readings, by role."""
    found: dict[str, list[tuple[float, float]]] = {}
    for batch in batches:
        for role, (series,) in decoder.decode(pack(batch)).items():
            found.setdefault(role.value, []).extend(zip(series.t.tolist(), series.value.tolist(), strict=True))
    return found


def battery(current: float, voltage: float, last: int = 20) -> bytes:
    """An answer of 62 bytes: identifier 0101 with current, voltage and, as its last byte, a temperature."""
    body = bytearray(range(100, 162))
    body[:3] = b"\x62\x01\x01"
    body[12:16] = round(10 * current).to_bytes(2, "big", signed=True) + round(10 * voltage).to_bytes(2, "big")
    body[61] = last
    return bytes(body)


def clock(speed: int) -> bytes:
    return b"\x62\x01\x00\x11" + bytes([speed]) + bytes(19)


def test_an_electric_car_whose_two_units_answer_at_once() -> None:
    """Battery 7EC and display 7BB interleave, with requests and flow control between them."""
    requests = [(0.0, 0x7E4, bytes.fromhex("0322010100000000")), (0.003, 0x7E4, bytes.fromhex("3000000000000000"))]
    both = [*segments(0.001, 0x7EC, battery(-12.5, 361.2)), *segments(0.0015, 0x7BB, clock(53)), *requests]
    decoder = decoder_of(KONA, KONA_ROLES)
    found = decoded(decoder, [sorted(both)])
    end = pytest.approx(0.001 + 8 * PERIOD)
    assert found == {
        "battery_current": [(end, pytest.approx(-12.5))],
        "battery_voltage": [(end, pytest.approx(361.2))],
        "ambient_temperature": [(end, pytest.approx(293.15))],
        "speed": [(pytest.approx(0.0015 + 3 * PERIOD), pytest.approx(53 / 3.6))],
    }
    assert not decoder.rejected + decoder.transport_rejected
    assert decoder.used == 2


def test_identifiers_of_29_bits_and_single_frames_with_the_length_in_front() -> None:
    rows = [
        *segments(0.0, 0x17FE007B, bytes.fromhex("621E3B") + (1444).to_bytes(2, "big")),
        *segments(0.1, 0x17FE007B, bytes.fromhex("621E3D00") + (-2550).to_bytes(3, "big", signed=True), pads=False),
        *segments(0.2, 0x17FE007B, bytes.fromhex("7F2231"), pads=False),  # a refusal
        *segments(0.3, 0x17FE007B, bytes.fromhex("621E3D00") + (1010).to_bytes(3, "big") + bytes(4)),  # two frames
    ]
    decoder = decoder_of(MEB, MEB_ROLES)
    found = decoded(decoder, [rows])
    assert found["battery_voltage"] == [(0.0, pytest.approx(361.0))]
    assert found["battery_current"] == [(0.1, pytest.approx(-25.5)), (pytest.approx(0.302), pytest.approx(10.1))]
    assert not decoder.transport_rejected
    assert set(decoder.rejected) <= {"MEB: no valid value"}


@pytest.mark.parametrize("lost", range(1, 9))
def test_a_lost_consecutive_frame_drops_one_reading_and_is_counted(lost: int) -> None:
    rows = [row for k in range(3) for row in segments(float(k), 0x7EC, battery(k, 360))]
    del rows[9 + lost]
    decoder = decoder_of(KONA, KONA_ROLES)
    assert [value for _, value in decoded(decoder, [rows])["battery_current"]] == pytest.approx([0.0, 2.0])
    reason = "consecutive frame lost or late" if lost < 8 else "answer broken off"
    assert dict(decoder.transport_rejected) == {f"BMS: {reason}": 1}


def test_a_late_frame_an_exchanged_one_and_one_cut_short() -> None:
    late, exchanged, short = (list(segments(10.0 * k, 0x7EC, battery(k, 360))) for k in range(3))
    late[4:] = [(t + 1.1, ident, data) for t, ident, data in late[4:]]
    exchanged[3], exchanged[4] = ((exchanged[k][0], *exchanged[7 - k][1:]) for k in (3, 4))
    short[5] = (*short[5][:2], short[5][2][:6])
    decoder = decoder_of(KONA, KONA_ROLES)
    assert decoded(decoder, [[*late, *exchanged, *short]]) == {}
    assert dict(decoder.transport_rejected) == {"BMS: consecutive frame lost or late": 3}


def test_the_longest_answer_and_those_that_are_too_long() -> None:
    long = KONA.replace("BO_ 2028 BMS: 62", "BO_ 2028 BMS: 4095").replace("495|8", f"{8 * 4094 + 7}|8")
    decoder = decoder_of(long, KONA_ROLES)
    payload = battery(5.0, 360).ljust(4094, b"\0") + bytes([33])
    escape = (1.5, 0x7EC, bytes.fromhex("1000FFFFFFFF6201"))
    impossible = (1.6, 0x7EC, bytes.fromhex("1007620101000000"))
    rows = [*segments(0.0, 0x7EC, payload), escape, (1.51, 0x7EC, b"\x21" + bytes(7)), impossible]
    found = decoded(decoder, [rows])
    assert found["ambient_temperature"] == [(pytest.approx(585 * PERIOD), pytest.approx(306.15))]
    assert dict(decoder.transport_rejected) == {
        "BMS: answer of more than 4095 bytes": 1,
        "BMS: impossible first frame": 1,
    }
    with pytest.raises(DatabaseError, match="beyond byte 4095"):
        decoder_of(long.replace(f"{8 * 4094 + 7}|8", f"{8 * 4095 + 7}|8"), KONA_ROLES)


def test_a_flood_of_first_frames_takes_no_memory() -> None:
    decoder = decoder_of(KONA, KONA_ROLES)
    flood = [(0.001 * k, 0x7EC, bytes.fromhex("1FFF620101000000")) for k in range(5000)]
    for batch in (flood[k : k + 500] for k in range(0, len(flood), 500)):
        decoder.decode(pack(batch))
    assert decoder.transport_rejected["BMS: answer broken off"] == 4999
    assert sum(len(frames) for each in decoder._iso_tp.values() for frames in each._open.values()) == 1
    found = decoded(decoder, [list(segments(6.0, 0x7EC, battery(7.0, 360)))])
    assert [value for _, value in found["battery_current"]] == [7.0]


def test_an_answer_that_lacks_the_bytes_of_one_signal_gives_the_others() -> None:
    decoder = decoder_of(KONA, KONA_ROLES)
    found = decoded(decoder, [list(segments(0.0, 0x7EC, battery(7.0, 360)[:30]))])
    assert [value for _, value in found["battery_current"]] == [7.0]
    assert np.isnan(found["ambient_temperature"][0][1])
    assert dict(decoder.rejected) == {"BMS.Last: short frame": 1}


def test_a_long_frame_of_can_fd_is_taken_as_it_is() -> None:
    decoder = decoder_of(KONA, KONA_ROLES)
    found = decoded(decoder, [[(0.0, 0x7EC, battery(7.0, 360).ljust(64, b"\0")), *segments(1.0, 0x7EC, battery(8, 1))]])
    assert [value for _, value in found["battery_current"]] == [7.0, 8.0]


answers = st.tuples(st.sampled_from([0x7EC, 0x7BB]), st.integers(1, 130), st.floats(0.001, 2.0))
faults = st.tuples(st.integers(0, 400), st.sampled_from(["drop", "repeat", "swap", "cut", "late", "flow"]))


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(answers, max_size=12), st.lists(faults, max_size=4), st.lists(st.integers(0, 200), max_size=5))
def test_any_traffic_in_any_batches_gives_the_same_bits(
    sent: list[tuple[int, int, float]], harm: list[tuple[int, str]], places: list[int]
) -> None:
    rows: list[Row] = []
    t = 0.0
    for ident, size, gap in sent:
        payload = (b"\x62\x01\x01" if ident == 0x7EC else b"\x62\x01\x00") + bytes(k % 251 for k in range(size))
        rows += segments(t, ident, payload)
        t += gap
    rows.sort(key=lambda row: row[0])
    for place, fault in harm if rows else []:
        at = place % len(rows)
        when, ident, data = rows[at]
        rows[at : at + 1] = {
            "drop": [],
            "repeat": [rows[at], rows[at]],
            "swap": [(when, ident, data[1:] + data[:1])],
            "cut": [(when, ident, data[: place % 8])],
            "late": [(when, ident, data)],
            "flow": [(when, ident, b"\x30" + bytes(7)), rows[at]],
        }[fault]
        if fault == "late":
            rows[at:] = [(when + 1.5, ident, data) for when, ident, data in rows[at:]]
        if not rows:
            return
    edges = [0, *sorted(min(place, len(rows)) for place in places), len(rows)]
    whole, parts = decoder_of(KONA, KONA_ROLES), decoder_of(KONA, KONA_ROLES)
    np.testing.assert_equal(
        decoded(parts, [rows[a:b] for a, b in itertools.pairwise(edges) if b > a]), decoded(whole, [rows])
    )
    assert parts.transport_rejected == whole.transport_rejected
    assert parts.rejected["BMS.Last: short frame"] == whole.rejected["BMS.Last: short frame"]


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.sampled_from([0x7EC, 0x7BB, 0x100]), st.binary(max_size=8)), max_size=40))
def test_arbitrary_frames_never_raise(rows: list[tuple[int, bytes]]) -> None:
    decoder = decoder_of(KONA, KONA_ROLES)
    decoder.decode(pack([(0.1 * k, ident, data) for k, (ident, data) in enumerate(rows)]))
    assert all(count > 0 for count in decoder.transport_rejected.values())
    assert Role.SPEED in decoder.decode(pack(list(segments(99.0, 0x7BB, clock(50)))))
