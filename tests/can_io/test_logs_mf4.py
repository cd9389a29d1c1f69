"""MF4 logs in every layout, against the frames they were made of and python-can's reader; and damaged ones."""

import struct
import tempfile
import tracemalloc
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import asammdf
import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mdf_files import START, Recorded, Style, mdf
from written_logs import FD_LENGTHS, assert_read_or_refused, message_of, recorded, write

from estimator.can_io.frames import Frames
from estimator.can_io.logs import open_log
from estimator.can_io.logs.mdf import unsorted_frames
from estimator.can_io.logs.mdf.groups import REAL, Field, Group, Times
from estimator.can_io.logs.mdf.locate import ROOM, Chain, locate
from estimator.can_io.logs.mdf.merging import merged
from estimator.can_io.logs.mdf.records import Rows, times
from estimator.errors import LogError

FIELDS = ("t", "ident", "length", "data")


def assert_same(frames: Frames, want: Frames) -> None:
    for field in FIELDS:
        assert np.array_equal(getattr(frames, field), getattr(want, field)), field


def frames_of(recording: list[Recorded], style: Style) -> Frames:
    return Frames.from_messages(
        can.Message(
            timestamp=time_of(one, style),
            arbitration_id=one.ident,
            is_extended_id=one.extended,
            data=one.data,
            is_fd=True,
        )
        for one in recording
        if one.kind == "data"
    )


def time_of(frame: Recorded, style: Style) -> float:
    return (round(frame.t * 1e9) * 1e-9 if style.ticks else frame.t) + START / 1e9


@st.composite
def recording(draw: st.DrawFn, longest: int) -> list[Recorded]:
    """Frames of a recording, the first with data."""
    found, t = [Recorded(t=0.25)], 0.25
    for _ in range(draw(st.integers(0, 40))):
        t += draw(st.sampled_from([0.0, 1e-3, 0.123456789]))
        extended = draw(st.booleans())
        kind = draw(st.sampled_from(["data"] * 6 + ["error", "remote"]))
        length = draw(st.sampled_from([8, 8, *(n for n in FD_LENGTHS if n <= longest)]))
        ident = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
        data = draw(st.binary(min_size=length, max_size=length)) if kind == "data" else b""
        found.append(Recorded(t=t, ident=ident, extended=extended, data=data, kind=kind))
    return found


LAYOUTS = [
    {"payload": "fixed", "width": 8},
    {"payload": "fixed", "width": 64, "open_flags": 1},
    {"payload": "values", "has_header_list": True},
    {"is_sorted": False, "payload": "fixed", "id_bytes": 4},
    {"is_sorted": False, "payload": "values", "id_bytes": 2},
    {"is_sorted": False, "payload": "values", "open_flags": 5},
    {"is_sorted": False, "payload": "values first"},
]
PACKINGS = [
    {"packing": "plain"},
    {"packing": "deflated", "ticks": True},
    {"packing": "plain", "block": 420},
    {"packing": "transposed", "block": 420},
]
READ_BY_OTHERS = [  # of the rest asammdf loses frames, raises errors, or never ends
    *(Style(**layout, **packing) for layout, packing in product(LAYOUTS[:4], PACKINGS)),
    *(Style(**LAYOUTS[4], **packing) for packing in (PACKINGS[1], PACKINGS[3])),
    Style(**LAYOUTS[5]),
]


@pytest.mark.slow
@pytest.mark.parametrize("style", READ_BY_OTHERS, ids=str)
def test_every_layout_is_read_as_python_can_reads_it(tmp_path: Path, style: Style) -> None:
    path, rng = tmp_path / "drive.mf4", np.random.default_rng(7)
    kinds = rng.choice(["data"] * 5 + ["error", "remote"], 60).tolist()
    frames = [
        replace(one, kind=kind, data=one.data[: style.width] if kind == "data" else b"")
        for one, kind in zip(random_frames(60, rng), kinds, strict=True)
    ]
    path.write_bytes(mdf(frames, style))
    found = Frames.concatenate(list(open_log(path)))
    assert_same(found, frames_of(frames, style))
    with can.LogReader(path) as reader:
        messages = [m for m in reader if not m.is_error_frame and not m.is_remote_frame]
    assert_same(found, Frames.from_messages(messages))


@pytest.mark.slow
@pytest.mark.parametrize("packing", PACKINGS, ids=str)
@pytest.mark.parametrize(
    "layout", [*LAYOUTS, {"is_column_store": True}, {"is_column_store": True, "payload": "values"}]
)
def test_every_layout_is_read_to_the_last_bit(layout: dict[str, Any], packing: dict[str, Any]) -> None:
    """Columns of values, whose times are a column of their own, too; python-can cannot read those."""
    style = Style(**layout, **packing)

    @settings(max_examples=8, deadline=None, derandomize=True)
    @given(recording(style.width if style.payload == "fixed" else 64))
    def check(frames: list[Recorded]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "drive.mf4")
            path.write_bytes(mdf(frames, style))
            log = open_log(path)
            assert_same(Frames.concatenate(list(log)), frames_of(frames, style))
        assert log.skipped["error frame"] == sum(frame.kind == "error" for frame in frames)
        assert log.skipped["remote frame"] == sum(frame.kind == "remote" for frame in frames)
        assert log.progress == 1.0

    check()


@pytest.mark.slow
@settings(max_examples=15, deadline=None, derandomize=True)
@given(recorded())
def test_what_python_can_writes_is_read_as_it_reads_it(messages: list[can.Message]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.mf4")
        write(path, messages)
        log = open_log(path)
        found = Frames.concatenate(list(log))
        with can.LogReader(path) as reader:
            want = [m for m in reader if not m.is_error_frame and not m.is_remote_frame]
    assert_same(found, Frames.from_messages(want))
    assert log.skipped["error frame"] == sum(m.is_error_frame for m in messages)
    assert log.skipped["remote frame"] == sum(m.is_remote_frame and not m.is_error_frame for m in messages)


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_what_asammdf_sorts_and_packs_is_read_the_same(tmp_path: Path, compression: int) -> None:
    frames = [Recorded(t=0.01 * i, data=bytes([i % 256] * (i % 9))) for i in range(1000)]
    path, saved = tmp_path / "drive.mf4", tmp_path / "saved.mf4"
    path.write_bytes(mdf(frames, Style(is_sorted=False, payload="values", open_flags=5)))
    with asammdf.MDF(path) as log:
        log.save(saved, compression=compression)
    found = Frames.concatenate(list(open_log(saved)))
    assert_same(found, Frames.concatenate(list(open_log(path))))
    assert len(found) == 1000


def random_frames(count: int, rng: np.random.Generator) -> list[Recorded]:
    lengths = rng.choice([0, 1, 2, 3, 8, 8, 8, 8, 8, 64], count).tolist()
    return [
        Recorded(t=1e-3 * i, ident=int(rng.integers(1 << 29)), data=rng.integers(0, 6, n, np.uint8).tobytes())
        for i, n in enumerate(lengths)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("payload", ["fixed", "values", "values first"])
def test_pieces_are_decoded_as_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, payload: str) -> None:
    frames = random_frames(3000, np.random.default_rng(5))
    path = tmp_path / "drive.mf4"
    style = Style(is_sorted=False, payload=payload)
    path.write_bytes(mdf(frames, style))
    for size in (400, 3000, 20_000, 1 << 21):
        monkeypatch.setattr(unsorted_frames, "JOINED", size)
        assert_same(Frames.concatenate(list(open_log(path))), frames_of(frames, style))


def kinds(*sizes: int) -> tuple[Group, ...]:
    """Kinds of records with ids from 1 on; a size of 0 is written in each record."""
    return tuple(
        Group(
            address=0,
            record_id=i + 1,
            record_bytes=size,
            count=0,
            has_variable_size=size == 0,
            frames=None,
            skipped="",
        )
        for i, size in enumerate(sizes)
    )


@pytest.mark.slow
@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 1 << 32), st.lists(st.sampled_from([0, 1, 7, 22, 90]), min_size=1, max_size=4), st.integers(0, 4))
def test_stretches_side_by_side_find_the_records_that_one_after_the_other_finds(
    seed: int, sizes: list[int], damage: int
) -> None:
    """Also where payloads look like records, and where bytes are damaged."""
    rng = np.random.default_rng(seed)
    raw = bytearray()
    while len(raw) < 60_000:
        kind = int(rng.integers(len(sizes)))
        size = sizes[kind] or int(rng.choice([0, 3, 8, 64, 3000], p=[0.2, 0.2, 0.4, 0.19, 0.01]))
        raw += bytes([kind + 1]) + (b"" if sizes[kind] else struct.pack("<L", size))
        raw += rng.integers(0, 4, size, np.uint8).tobytes()
    for _ in range(damage):
        raw[rng.integers(len(raw))] = rng.integers(256)
    groups = kinds(*sizes)
    data = bytes(raw) + bytes(ROOM)
    found = locate(data, 1, groups)
    chain = Chain(data, 1, groups)
    want = chain.walk(0)
    steps = chain.steps(want)
    complete = want[(steps > 0) & (want + steps <= len(raw))]
    assert found.at.tolist() == complete.tolist()
    assert found.used == (int((complete + steps[: len(complete)])[-1]) if len(complete) else 0)
    assert bool(found.fault) == (steps[-1] == 0)


@pytest.mark.slow
@given(
    st.lists(st.lists(st.sampled_from([0.0, 1.0, 2.0, 3.0, 5.0]), max_size=12), min_size=1, max_size=4),
    st.integers(1, 5),
)
def test_streams_are_merged_as_heapq_merges_them(streams: list[list[float]], size: int) -> None:
    import heapq

    def batches(t: list[float], channel: int) -> list[Frames]:
        every = Frames.from_messages(
            can.Message(timestamp=one, arbitration_id=i, data=bytes([channel])) for i, one in enumerate(t)
        )
        return [every[first : first + size] for first in range(0, len(t), size)]

    found = Frames.concatenate(list(merged([iter(batches(t, i)) for i, t in enumerate(streams)])))
    entries = [[(one, i, k) for k, one in enumerate(t)] for i, t in enumerate(streams)]
    want = list(heapq.merge(*entries, key=lambda entry: entry[0]))
    assert [(t, int(d), int(k) & 0xFF) for t, d, k in zip(found.t, found.data[:, 0], found.ident, strict=True)] == want


# Bad input


def refusal(tmp_path: Path, raw: bytes) -> str:
    (tmp_path / "a.mf4").write_bytes(raw)
    text = message_of(tmp_path / "a.mf4")
    assert "byte" in text or "0 frames" in text
    return text


WHOLE = [Recorded(t=0.01 * i) for i in range(300)]
DAMAGED = [
    Style(),
    Style(packing="transposed", block=780),
    Style(payload="values", block=780, packing="deflated", has_header_list=True),
    Style(is_sorted=False, payload="values"),
    Style(is_sorted=False, payload="values first", open_flags=5),
    Style(is_column_store=True, block=780),
]


@pytest.mark.slow
@pytest.mark.parametrize("style", DAMAGED, ids=str)
def test_damage_is_read_or_refused(tmp_path: Path, style: Style) -> None:
    assert_read_or_refused(tmp_path / "a.mf4", mdf(WHOLE, style), np.random.default_rng(3), rounds=150)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [b"##HD", b"##DG", b"##CG", b"##CN", b"##DL", b"##DT"])
@pytest.mark.parametrize("value", [0, 23, 2**40, 2**64 - 1])
@pytest.mark.parametrize("field", [8, 16, 24, 32])
def test_wrong_sizes_and_links_cost_neither_time_nor_memory(
    tmp_path: Path, kind: bytes, value: int, field: int
) -> None:
    raw = bytearray(mdf(WHOLE, Style(block=780)))
    at = raw.index(kind) + field
    raw[at : at + 8] = struct.pack("<Q", value)
    (tmp_path / "a.mf4").write_bytes(raw)
    tracemalloc.start()
    try:
        frames = Frames.concatenate(list(open_log(tmp_path / "a.mf4")))
    except LogError as error:
        assert str(error).startswith(str(tmp_path / "a.mf4"))  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert len(frames)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


@pytest.mark.parametrize(("kind", "link"), [(b"##DG", 24), (b"##CG", 24), (b"##CN", 24), (b"##DL", 24)])
def test_links_in_a_circle_are_refused(tmp_path: Path, kind: bytes, link: int) -> None:
    raw = bytearray(mdf(WHOLE, Style(block=780)))
    at = raw.rindex(kind)  # the first in its chain
    raw[at + link : at + link + 8] = struct.pack("<Q", at)
    text = refusal(tmp_path, bytes(raw))
    assert "without end" in text or "again and again" in text


def test_blocks_listed_again_and_again_are_refused(tmp_path: Path) -> None:
    raw = mdf(WHOLE, Style(block=7800, times_listed=20, open_flags=1))
    assert "listed again and again" in refusal(tmp_path, raw)


def test_blocks_that_were_not_listed_before_the_power_was_lost_are_found(tmp_path: Path) -> None:
    style = Style(is_sorted=False, payload="values", block=780, open_flags=21)
    raw = bytearray(mdf(WHOLE, style))
    at = raw.index(b"##DL")  # the last of them
    (size,) = struct.unpack_from("<Q", raw, at + 8)
    raw[at + 32 : at + size - 16] = bytes(size - 48)
    (tmp_path / "a.mf4").write_bytes(raw)
    assert_same(Frames.concatenate(list(open_log(tmp_path / "a.mf4"))), frames_of(WHOLE, style))


def test_a_packed_block_of_absurd_size_is_refused(tmp_path: Path) -> None:
    raw = bytearray(mdf(WHOLE, Style(packing="deflated")))
    at = raw.index(b"##DZ") + 32
    raw[at : at + 8] = struct.pack("<Q", 1 << 40)
    assert f"packed block of {1 << 40} bytes" in refusal(tmp_path, bytes(raw))


def test_what_is_before_the_cut_is_read(tmp_path: Path) -> None:
    """Frames before the cut come first, then the complaint; a file left open ends where it ends."""
    path = tmp_path / "a.mf4"
    path.write_bytes(mdf(WHOLE, Style(is_sorted=False, payload="values"))[:-1000])
    frames: list[Frames] = []
    with pytest.raises(LogError, match=r"cut at byte \d+ .* after \d+ frames"):
        frames.extend(open_log(path))
    assert 0 < sum(map(len, frames)) < 300


@pytest.mark.parametrize("lost", [1, 7, 20, 36])
def test_a_file_left_open_ends_where_the_power_was_lost(tmp_path: Path, lost: int) -> None:
    raw = mdf(WHOLE, Style(is_sorted=False, payload="values", open_flags=5))
    path = tmp_path / "a.mf4"
    path.write_bytes(raw[:-lost])
    assert len(Frames.concatenate(list(open_log(path)))) == 299
    path.write_bytes(raw + bytes(5000))  # room that was reserved
    assert len(Frames.concatenate(list(open_log(path)))) == 300


def test_a_log_of_other_values_is_named(tmp_path: Path) -> None:
    raw = mdf(WHOLE, Style()).replace(b"CAN_DataFrame", b"LIN_DataFrame")
    (tmp_path / "a.mf4").write_bytes(raw)
    message = message_of(tmp_path / "a.mf4")
    assert "no CAN frames in it, only other values; give the log of the bus, or, if they are decoded" in message
    assert '--map speed="COLUMN [km/h]"' in message


def test_an_older_version_is_named(tmp_path: Path) -> None:
    raw = bytearray(mdf(WHOLE, Style()))
    raw[28:30] = struct.pack("<H", 330)
    (tmp_path / "a.mf4").write_bytes(raw)
    assert "MDF version 3.30; convert it to version 4" in message_of(tmp_path / "a.mf4")


def test_times_that_are_no_numbers_give_no_warning() -> None:
    raw = np.array([1.0, np.inf, -np.inf, np.nan, 1e308])
    layout = Times(Field(byte=0, bit=0, bits=64, kind=REAL[0]), 10.0, 1.0)
    found = times(Rows(raw.tobytes(), 8, len(raw)), layout, np.inf)
    assert found[0] == np.inf
    assert np.isnan(found[2])
