"""Parameter group numbers, special values, and the reassembly of broadcasts under every fault a bus has."""

import itertools

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.j1939 import MAX_BYTES, T1, MultiPacket, Transport, classify, pgn_of

EC1 = 0xFEE3
Row = tuple[float, int, bytes]


def pack(rows: list[Row]) -> Frames:
    return Frames.from_messages(can.Message(timestamp=t, arbitration_id=i, data=data) for t, i, data in rows)


def announcement(t: float, source: int, size: int, packets: int | None = None, pgn: int = EC1) -> Row:
    count = -(-size // 7) if packets is None else packets
    return (
        t,
        0x1CECFF00 | source,
        b"\x20" + size.to_bytes(2, "little") + bytes([count, 0xFF]) + pgn.to_bytes(3, "little"),
    )


def transfer(t: float, source: int, sequence: int, data: bytes = b"") -> Row:
    return t, 0x1CEBFF00 | source, bytes([sequence]) + data.ljust(7, b"\xff")


def broadcast(t: float, source: int, payload: bytes, pgn: int = EC1, period: float = 0.05) -> list[Row]:
    chunks = [payload[k : k + 7] for k in range(0, len(payload), 7)]
    return [announcement(t, source, len(payload), pgn=pgn)] + [
        transfer(t + period * (k + 1), source, k + 1, chunk) for k, chunk in enumerate(chunks)
    ]


def feed(rows: list[Row]) -> tuple[list[MultiPacket], dict[str, int]]:
    transport = Transport()
    return transport.feed(pack(rows)), dict(transport.rejected)


PAYLOAD = bytes(range(39))


def test_group_numbers() -> None:
    # EEC1 of the engine, TSC1 from the transmission to the engine, TP.CM to all, proprietary B, the data page.
    idents = np.array([0x0CF00400, 0x0C000003, 0x1CECFF00, 0x18FFFF21, 0x19FEF121, 0x98FEF100], np.uint32)
    assert pgn_of(idents).tolist() == [0xF004, 0, 0xEC00, 0xFFFF, 0x1FEF1, 0xFEF1]


@given(st.integers(0, 7), st.integers(0, 3), st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_group_number_of_any_id(priority: int, page: int, pf: int, ps: int, source: int) -> None:
    ident = np.array([priority << 26 | page << 24 | pf << 16 | ps << 8 | source], np.uint32)
    assert pgn_of(ident)[0] == page << 16 | pf << 8 | (ps if pf >= 240 else 0)


@pytest.mark.parametrize(("length", "codes"), [(2, "vven"), (4, "vvvvvvvvvvvvvven"), (8, "v" * 251 + "rrren")])
def test_special_values_of_every_code(length: int, codes: str) -> None:
    masks = classify(np.arange(1 << length, dtype=np.uint64), length)
    assert [{(1, 0, 0): "n", (0, 1, 0): "e", (0, 0, 1): "r"}.get(m, "v") for m in zip(*masks, strict=True)] == list(
        codes
    )


@given(st.sampled_from([16, 32]), st.integers(0, 255), st.integers(0, 2**32))
def test_wide_values_follow_their_top_byte(length: int, top: int, rest: int) -> None:
    raw = top << length - 8 | rest % (1 << length - 8)
    wide = [m[0] for m in classify(np.array([raw], np.uint64), length)]
    assert wide == [m[0] for m in classify(np.array([top], np.uint64), 8)]


@pytest.mark.parametrize("length", [1, 3, 5, 6, 7])
def test_other_widths_have_no_special_values(length: int) -> None:
    assert not np.any(classify(np.arange(1 << length, dtype=np.uint64), length))


def test_a_broadcast_as_recorded() -> None:
    assert feed(broadcast(10.0, 0, PAYLOAD)) == ([MultiPacket(10.0 + 0.05 * 6, EC1, 0, PAYLOAD)], {})


@pytest.mark.parametrize("size", [9, 14, 15, MAX_BYTES])
def test_any_allowed_size(size: int) -> None:
    payload = bytes(k % 251 for k in range(size))
    assert feed(broadcast(0.0, 3, payload)) == ([MultiPacket(0.05 * -(-size // 7), EC1, 3, payload)], {})


def test_broadcasts_of_several_sources_interleave() -> None:
    each = [broadcast(0.001 * s, s, bytes([s]) * (9 + s), pgn=0xFE00 + s) for s in range(30)]
    messages, rejected = feed(sorted(itertools.chain(*each)))
    assert not rejected
    assert sorted((m.source, m.pgn, m.payload) for m in messages) == [
        (s, 0xFE00 + s, bytes([s]) * (9 + s)) for s in range(30)
    ]


@pytest.mark.parametrize("k", range(1, 7))
def test_a_lost_packet_drops_the_message_whole(k: int) -> None:
    rows = broadcast(0.0, 0, PAYLOAD)
    messages, rejected = feed(rows[:k] + rows[k + 1 :] + broadcast(1.0, 0, PAYLOAD))
    assert [m.t for m in messages] == [pytest.approx(1.3)]
    # The end of a message is only missed when the next one starts.
    assert rejected == {f"transport: {'packet late or lost' if k < 6 else 'broken off'}": 1}


@pytest.mark.parametrize("k", range(1, 6))
def test_a_repeated_packet_does_no_harm(k: int) -> None:
    rows = broadcast(0.0, 0, PAYLOAD)
    messages, rejected = feed(rows[: k + 1] + rows[k:])
    assert [m.payload for m in messages] == [PAYLOAD]
    assert rejected == {"transport: packet repeated": 1}


def test_exchanged_packets_drop_the_message_whole() -> None:
    rows = broadcast(0.0, 0, PAYLOAD)
    rows[2], rows[3] = rows[3], rows[2]
    assert feed(rows) == ([], {"transport: packet late or lost": 1})


@pytest.mark.parametrize(("period", "whole"), [(T1, True), (T1 + 1e-6, False), (-0.01, False), (0.0, True)])
def test_packets_must_follow_each_other_in_time(period: float, whole: bool) -> None:
    messages, rejected = feed(broadcast(0.0, 0, PAYLOAD, period=period))
    assert len(messages) == whole
    assert rejected == ({} if whole else {"transport: packet late or lost": 1})


@pytest.mark.parametrize(("size", "packets"), [(0, 0), (8, 2), (MAX_BYTES + 1, 255), (65535, 255), (39, 5), (39, 7)])
def test_impossible_announcements(size: int, packets: int) -> None:
    transfers = [transfer(0.1 * k, 0, k) for k in range(1, 8)]
    assert feed([announcement(0.0, 0, size, packets), *transfers]) == ([], {"transport: impossible announcement": 1})


def test_what_follows_an_impossible_announcement_does_not_belong_to_the_one_before() -> None:
    rows = [announcement(0.0, 0, 39), announcement(0.1, 0, 39, 7), *broadcast(0.1, 0, PAYLOAD)[1:]]
    assert feed(rows) == ([], {"transport: broken off": 1, "transport: impossible announcement": 1})


def test_a_new_announcement_ends_the_open_one() -> None:
    messages, rejected = feed(broadcast(0.0, 0, PAYLOAD)[:4] + broadcast(0.2, 0, b"\7" * 20, pgn=0xFEE1))
    assert [(m.pgn, m.payload) for m in messages] == [(0xFEE1, b"\7" * 20)]
    assert rejected == {"transport: broken off": 1}


def test_an_abort_ends_the_open_one() -> None:
    rows = broadcast(0.0, 0, PAYLOAD)
    abort = (0.12, 0x1CECFF00, b"\xff" * 8)
    assert feed([*rows[:3], abort, *rows[3:], abort]) == ([], {"transport: broken off": 1})


def test_short_packets_are_counted_and_others_survive() -> None:
    rows = [
        *broadcast(0.0, 0, PAYLOAD),
        *broadcast(0.001, 1, PAYLOAD),
        (0.04, 0x1CEBFF01, b"\1\2"),
        (0.04, 0x1CECFF02, b""),
    ]
    messages, rejected = feed(sorted(rows))
    assert [m.source for m in messages] == [0, 1]
    assert rejected == {"transport: short frame": 2}


def test_what_is_no_broadcast_is_passed_over() -> None:
    rows = [
        transfer(0.0, 0, 1),  # nothing announced: the log began in the middle
        (0.1, 0x1CEC2100, announcement(0, 0, 39)[2]),  # to one node
        (0.2, 0x1CEB2100, transfer(0, 0, 1)[2]),
        (0.3, 0x1CECFF00, b"\x10" + bytes(7)),  # request to send, which nobody may broadcast
        (0.4, 0x1DECFF00, announcement(0, 0, 39)[2]),  # another data page
    ]
    assert feed(rows) == ([], {})
    standard = Frames(*(getattr(pack(broadcast(0.0, 0, PAYLOAD)), name) for name in Frames.__slots__))
    standard.ident[:] &= 0x7FF
    assert Transport().feed(standard) == []


def to_node(t: float, source: int, node: int, payload: bytes, window: int = 255, period: float = 0.01) -> list[Row]:
    """A message by RTS and CTS between two nodes, with what the receiver answers."""
    rows = [(t, 0x1CEC0000 | node << 8 | source, b"\x10" + announcement(0, source, len(payload))[2][1:])]
    back = 0x1CEC0000 | source << 8 | node
    chunks = [payload[k : k + 7] for k in range(0, len(payload), 7)]
    for k, chunk in enumerate(chunks):
        t += period
        if k % window == 0:
            rows.append((t - period / 2, back, bytes([0x11, min(window, 255), k + 1, 0xFF, 0xFF, 0xE3, 0xFE, 0x00])))
        rows.append((t, 0x1CEB0000 | node << 8 | source, transfer(0, source, k + 1, chunk)[2]))
    size = len(payload).to_bytes(2, "little")
    return [*rows, (t + period, back, b"\x13" + size + bytes([len(chunks), 0xFF, 0xE3, 0xFE, 0x00]))]


@pytest.mark.parametrize("window", [1, 4, 255])
def test_a_message_between_two_nodes_is_joined_while_listening(window: int) -> None:
    rows = to_node(1.0, 0, 0xF9, PAYLOAD, window)
    assert feed(rows) == ([MultiPacket(pytest.approx(1.06), EC1, 0, PAYLOAD, destination=0xF9)], {})
    # A broadcast of the same node, and its answer to another one, do not disturb it; neither does the other direction.
    others = [*broadcast(1.005, 0, b"\1" * 20), *to_node(1.004, 0xF9, 0, b"\2" * 30)]
    messages, rejected = feed(sorted(rows + others))
    assert sorted((m.payload, m.destination) for m in messages) == [
        (PAYLOAD, 0xF9),
        (b"\1" * 20, 0xFF),
        (b"\2" * 30, 0),
    ]
    assert rejected == {}


def test_a_receiver_may_wait_and_ask_again_but_not_without_end() -> None:
    rows = to_node(0.0, 0, 0xF9, PAYLOAD, period=0.1)
    waited = [(t + 1.4 * (t > 0.31), ident, data) for t, ident, data in rows]
    assert feed(waited)[1] == {"transport: packet late or lost": 1}
    wait = (0.9, 0x1CEC00F9, bytes.fromhex("1100FFFFFFE3FE00"))
    assert [m.payload for m in feed(sorted([*waited, wait]))[0]] == [PAYLOAD]
    again = sorted([*rows, *[(0.45, ident, data) for _, ident, data in rows[2:4]]])
    messages, rejected = feed(again)
    assert [m.payload for m in messages] == [PAYLOAD]
    assert rejected == {"transport: packet repeated": 2}


def test_a_second_message_to_another_node_breaks_off_the_first() -> None:
    first, second = to_node(0.0, 0, 0xF9, PAYLOAD), to_node(0.035, 0, 0x21, PAYLOAD)
    messages, rejected = feed(sorted(first + second))
    assert [m.destination for m in messages] == [0x21]
    assert rejected == {"transport: broken off": 1}


sources = st.integers(0, 255)
packets = st.tuples(
    st.sampled_from([0.0, 0.05, 0.1, 0.7, 0.8, -0.1]),
    st.builds(
        lambda kind, low: kind | low,
        st.sampled_from([0x1CECFF00, 0x1CEBFF00, 0x1CEC0100, 0x1CEB0100]),
        st.integers(0, 3) | sources,
    )
    | st.integers(0, (1 << 29) - 1),
    st.binary(max_size=8)
    | st.binary(min_size=8, max_size=8)
    | st.builds(lambda k: transfer(0, 0, k)[2], st.integers(0, 4))
    | st.builds(lambda size: announcement(0, 0, size)[2], st.integers(0, 30))
    | st.builds(lambda size: b"\x10" + announcement(0, 0, size)[2][1:], st.integers(9, 30))
    | st.builds(lambda count: bytes([0x11, count, 1, 0xFF, 0xFF, 0xE3, 0xFE, 0x00]), st.integers(0, 2)),
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(packets, max_size=60), st.lists(st.integers(0, 60), max_size=4))
def test_arbitrary_frames_in_arbitrary_batches(events: list[Row], places: list[int]) -> None:
    t = list(itertools.accumulate(step for step, *_ in events))
    rows = [(t, ident, data) for t, (_, ident, data) in zip(t, events, strict=True)]
    whole = Transport()
    expected = whole.feed(pack(rows))
    parts = Transport()
    edges = [0, *sorted(min(p, len(rows)) for p in places), len(rows)]
    assert [m for a, b in itertools.pairwise(edges) for m in parts.feed(pack(rows[a:b]))] == expected
    assert parts.rejected == whole.rejected
    assert all(8 < len(m.payload) <= MAX_BYTES for m in expected)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.lists(st.tuples(st.integers(0, 2), st.integers(9, 40), st.sampled_from([0.05, 0.05, 0.7])), max_size=12),
    st.lists(st.tuples(st.integers(0, 200), st.sampled_from(["drop", "repeat", "swap", "late", "abort"])), max_size=5),
    st.integers(0, 200),
)
def test_many_broadcasts_at_once_are_joined_as_one_by_one(
    sent: list[tuple[int, int, float]], faults: list[tuple[int, str]], cut: int
) -> None:
    each = [
        to_node(2.0 * i, source, 1, bytes(range(size)), 3, period)
        if size % 3 == 0
        else broadcast(2.0 * i, source, bytes(range(size)), period=period)
        for i, (source, size, period) in enumerate(sent)
    ]
    rows = sorted(itertools.chain(*each))
    for place, fault in faults:
        if not rows:
            break
        at = place % len(rows)
        t, ident, data = rows[at]
        rows[at : at + 1] = {
            "drop": [],
            "repeat": [rows[at], rows[at]],
            "swap": [*rows[at + 1 : at + 2], rows[at]],
            "late": [(t + 1.0, ident, data)],
            "abort": [(t, 0x1CEC0000 | ident & 0xFFFF, b"\xff" + data[1:]), rows[at]],
        }[fault]

    def outcome(least: int) -> tuple[list[MultiPacket], dict[str, int]]:
        transport = Transport()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("estimator.can_io.j1939.MIN_AT_ONCE", least)
            found = [*transport.feed(pack(rows[:cut])), *transport.feed(pack(rows[cut:]))]
        return found, dict(transport.rejected)

    assert outcome(1) == outcome(10**9)


@pytest.mark.slow
def test_memory_is_bounded() -> None:
    rng = np.random.default_rng(1)
    n = 20_000
    transport = Transport()
    rows = [announcement(0.0, source, MAX_BYTES) for source in range(256)]
    rows += [(0.0, 0x1CEC0000 | k, b"\x10" + rows[0][2][1:]) for k in range(1 << 16)]  # to every node
    for k in range(n):
        source, kind = int(rng.integers(256)), rng.random()
        rows.append(announcement(0.0, source, MAX_BYTES) if kind < 0.1 else transfer(0.0, source, k % 3 + 1))
    transport.feed(pack(rows))
    assert len(transport._sessions) <= 512
    assert all(len(s.payload) <= MAX_BYTES + 6 for s in transport._sessions.values())
