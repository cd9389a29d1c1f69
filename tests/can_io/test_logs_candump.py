"""The candump reader: both forms, exact values, and bad lines named."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.logs import Log, open_log
from estimator.can_io.logs.line_log import CHUNK
from estimator.errors import LogError


def read(path: Path, text: str | bytes) -> tuple[Log, Frames]:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    log = open_log(path)
    return log, Frames.concatenate(list(log))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "drive.log"


@pytest.mark.parametrize(
    ("line", "t", "ident", "data"),
    [
        ("(1436509052.249713) vcan0 044#2A366C2B", 1436509052.249713, 0x44, "2A366C2B"),
        ("(0.5) can0 18fef100#0011223344556677 R", 0.5, 0x18FEF100 | EXTENDED, "0011223344556677"),
        ("(1700000000.123456789) can0 123#", 1700000000.123456789, 0x123, ""),
        ("(1.0) can0 123##1" + "AB" * 64, 1.0, 0x123, "AB" * 64),
        ("(1.0) can0 123##0", 1.0, 0x123, ""),
        ("(1.0) can0 123#1122334455667788_F T extra", 1.0, 0x123, "1122334455667788"),
        ("(1.0) can0 123#11\r", 1.0, 0x123, "11"),
        (" (000.005001)  can0  18FEDF00   [8]  8A A0 28 7D 7D FF FF F5", 0.005001, 0x98FEDF00, "8AA0287D7DFFFFF5"),
        (" (000.1)  can0  123   [0]", 0.1, 0x123, ""),
        (" (000.1)  can0  RX - -  123   [1]  00", 0.1, 0x123, "00"),
        (" (000.1)  can0  123  [12]  " + " ".join(["0F"] * 12), 0.1, 0x123, "0F" * 12),
        (" (000.1)  can0  123   [2]  41 27   'A''", 0.1, 0x123, "4127"),
    ],
)
def test_forms(path: Path, line: str, t: float, ident: int, data: str) -> None:
    _, frames = read(path, f"\n{line}\n  \r\n")
    assert frames.t.tolist() == [t]
    assert frames.ident.tolist() == [ident]
    assert bytes(frames.data[0, : frames.length[0]]).hex().upper() == data
    assert frames.data.shape[1] == (8 if len(data) <= 16 else 64)


def test_remote_and_error_frames_are_counted(path: Path) -> None:
    log, frames = read(
        path,
        "(1.0) can0 123#11\n(1.0) can0 123#R\n(1.0) can0 18FEF100#R8\n(1.0) can0 20000080#0000000000000000\n"
        " (1.0)  can0  123   [4]  remote request\n"
        " (1.0)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME\n",
    )
    assert len(frames) == 1
    assert log.skipped == {"remote frame": 3, "error frame": 2}


HEX = "0123456789abcdefABCDEF"


@st.composite
def line(draw: st.DrawFn) -> tuple[str, int, bytes]:
    """A line without its time, its id and its payload."""
    extended = draw(st.booleans())
    ident = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    data = draw(st.binary(max_size=8) | st.sampled_from([bytes(12), bytes(range(64))]))
    name = f"{ident:08X}" if extended else f"{ident:03X}"
    iface = ("can0", "vcan10")[ident % 2]  # no identifier on two channels
    if draw(st.booleans()):
        text = f"{iface} {name}#{'#1' * (len(data) > 8)}{data.hex()}{draw(st.sampled_from(['', ' R', ' T']))}"
    else:
        length = f"[{len(data):02d}]" if len(data) > 8 else f" [{len(data)}]"
        text = f" {iface}  {name}  {length}  {data.hex(' ').upper()}"
    return text, ident | (EXTENDED if extended else 0), data


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(lines=st.lists(line(), min_size=1, max_size=40), start=st.integers(0, 2_000_000_000), digits=st.integers(1, 9))
def test_mixed_lines_are_read_exactly(lines: list[tuple[str, int, bytes]], start: int, digits: int) -> None:
    times = [f"{start + i // 10}.{i % 10:0{digits}d}" for i in range(len(lines))]
    with tempfile.TemporaryDirectory() as folder:
        _, frames = read(
            Path(folder) / "a.log", "".join(f"({t}) {text}\n" for t, (text, _, _) in zip(times, lines, strict=True))
        )
    assert np.allclose(frames.t, [float(t) for t in times], rtol=3e-16, atol=0)
    assert frames.ident.tolist() == [ident for _, ident, _ in lines]
    assert [bytes(row[:n]) for row, n in zip(frames.data, frames.length, strict=True)] == [data for *_, data in lines]


def test_lines_across_chunks(path: Path) -> None:
    count = 3 * CHUNK // 40
    log, frames = read(path, "".join(f"({i}.5) can0 18FEF100#{i:016X}\n" for i in range(count)))
    assert frames.data.view(">u8")[:, 0].tolist() == list(range(count))
    assert log.progress == 1.0


GOOD = "(1.0) can0 123#11\n"


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("can0  18FEDF00   [8]  8A A0 28 7D 7D FF FF F5", "expected a time"),
        ("(1.0) can0 123#1", "expected '(14"),
        ("(1.0) can0 123#112233445566778899", "expected at most 8 data bytes, found 9"),
        ("(1.0) can0 123##1" + "00" * 65, "expected at most 64"),
        ("(1.0) can0 FFF#11", "FFF, which is too large"),
        ("(1.0) can0 7FFFFFFF#11", "too large"),
        ("(1.0) can0 1234#11", "expected '(14"),
        ("(-1.0) can0 123#11", "expected '(14"),
        ("(1.0)  can0  123   [3]  11 22", "expected 3 data bytes, found 2"),
        ("(1.0)  can0  123   [9]  11 22 33 44 55 66 77 88 99", "at most 8"),
        ("x" * 5000, "a line of 5000 bytes"),
        ("\0\0", "found"),
        ("(1.0) can0 123#1g", "found"),
    ],
)
@pytest.mark.parametrize("before", [0, 3])
def test_of_many_bad_lines_the_first_is_named(path: Path, bad: str, reason: str, before: int) -> None:
    path.write_text(GOOD * before + bad + "\n" + GOOD + "nonsense\n" * (before + 1))
    batches = iter(open_log(path))
    if before:
        assert len(next(batches)) == before
    with pytest.raises(LogError) as caught:
        next(batches)
    assert str(caught.value).startswith(f"{path}:{before + 1}: ")
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    "last", ["(1.0) can0 123#1", "(1.0) can0 18FEF1", "(1.", "(1.0)  can0  123   [2]  11", "(1.0)  can0  123   [1]  1"]
)
def test_a_last_line_cut_short_is_counted(path: Path, last: str) -> None:
    log, frames = read(path, GOOD + last)
    assert len(frames) == 1
    assert log.skipped == {"damaged line (the first is line 2)": 1}
    with pytest.raises(LogError, match=r":1: the file ends inside this line"):
        read(path, last)


@pytest.mark.parametrize(
    "last",
    ["(1.0) can0 123#1122334455667788", "(1.0) can0 123#11", "(1.0) can0 123#11 R", " (1.0)  can0  123   [1]  11"],
)
def test_a_last_line_that_parses_needs_no_line_break(path: Path, last: str) -> None:
    assert len(read(path, GOOD + last)[1]) == 2


def test_no_newline_at_all(path: Path) -> None:
    with pytest.raises(LogError, match=":1: "):
        read(path, b"\xff" * (3 * CHUNK))


def test_a_long_run_of_blanks_takes_no_time(path: Path) -> None:
    with pytest.raises(LogError, match=":1: "):
        read(path, "(1.0) can0 123#11" + " \t" * 200_000 + "\x01\n")


@settings(max_examples=120, deadline=None, derandomize=True)
@pytest.mark.slow
@given(
    lines=st.lists(line(), min_size=1, max_size=4),
    flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=3),
    cut=st.integers(0, 10_000),
)
def test_damaged_lines_are_read_or_refused(
    lines: list[tuple[str, int, bytes]], flips: list[tuple[int, int]], cut: int
) -> None:
    raw = bytearray("".join(f"(1.0) {text}\n" for text, _, _ in lines).encode())
    for at, value in flips:
        raw[at % len(raw)] = value
    with tempfile.TemporaryDirectory() as folder:
        try:
            read(Path(folder) / "a.log", bytes(raw[: cut % len(raw) + 1]))
        except LogError as error:
            assert "\n" not in str(error)  # noqa: PT017
