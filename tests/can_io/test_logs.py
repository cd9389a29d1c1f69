"""Logs of every format: what is read back equals what was written, and what is wrong is a LogError of one line."""

import gzip
import tempfile
from collections import deque
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from written_logs import assert_read_or_refused, message_of, recorded, write

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.logs import Log, open_log
from estimator.can_io.logs.log import BATCH, regroup
from estimator.can_io.logs.time_check import MAX_STEPS_BACK, TimeCheck
from estimator.errors import LogError


def read(path: Path) -> tuple[Log, Frames]:
    log = open_log(path)
    return log, Frames.concatenate(list(log))


def assert_same(frames: Frames, messages: list[can.Message], tolerance: float) -> None:
    data = [m for m in messages if not m.is_error_frame and not m.is_remote_frame]
    assert frames.ident.tolist() == [m.arbitration_id | (EXTENDED if m.is_extended_id else 0) for m in data]
    assert [bytes(row[:n]) for row, n in zip(frames.data, frames.length, strict=True)] == [bytes(m.data) for m in data]
    assert not np.where(np.arange(frames.data.shape[1]) < frames.length[:, None], 0, frames.data).any()
    t = np.array([m.timestamp for m in data])
    assert np.allclose(np.diff(frames.t), np.diff(t), rtol=0, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "tolerance", "fd", "others"),
    [
        (".blf", 2e-6, True, True),
        (".log", 2e-6, True, True),
        (".asc", 2e-6, True, True),
        (".csv", 1e-9, False, True),
        (".trc", 1e-3, False, False),  # its writer takes data frames only
    ],
)
def test_what_python_can_writes_is_read_back(suffix: str, tolerance: float, fd: bool, others: bool) -> None:
    @settings(max_examples=30, deadline=None, derandomize=True)
    @given(messages=recorded(fd, others))
    def check(messages: list[can.Message]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"drive{suffix}"
            write(path, messages)
            log, frames = read(path)
        assert_same(frames, messages, tolerance)
        assert log.skipped["error frame"] == sum(m.is_error_frame for m in messages)
        assert log.skipped["remote frame"] == sum(m.is_remote_frame and not m.is_error_frame for m in messages)
        assert log.progress == 1.0

    check()


def test_mf4_is_read_back(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    messages = drive(300)
    write(tmp_path / "drive.MF4", messages)
    log, frames = read(tmp_path / "drive.MF4")
    assert_same(frames, messages, 1e-6)
    assert log.progress == 1.0


def drive(count: int) -> list[can.Message]:
    return [
        can.Message(timestamp=1.7e9 + 0.01 * i, arbitration_id=0x18FEF100, data=i.to_bytes(8, "little"))
        for i in range(count)
    ]


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".csv", ".trc"])
def test_gzip_and_upper_case(tmp_path: Path, suffix: str) -> None:
    messages = drive(100)
    write(tmp_path / f"drive{suffix}", messages)
    packed = tmp_path / f"DRIVE{suffix.upper()}.GZ"
    packed.write_bytes(gzip.compress((tmp_path / f"drive{suffix}").read_bytes()))
    log, frames = read(packed)
    assert_same(frames, messages, 1e-3)
    assert log.progress == 1.0
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(LogError, match="cannot be read on"):
        read(packed)
    packed.write_bytes((tmp_path / f"drive{suffix}").read_bytes())
    with pytest.raises(LogError, match="is no gzip file"):
        read(packed)


def test_a_log_can_be_iterated_twice_and_left_half_way(tmp_path: Path) -> None:
    write(tmp_path / "drive.csv", [*drive(50), can.Message(timestamp=1.8e9, is_error_frame=True)])
    log = open_log(tmp_path / "drive.csv")
    next(iter(log))
    assert [sum(map(len, log)), sum(map(len, log))] == [50, 50]
    assert log.skipped == {"error frame": 1}


@pytest.mark.slow
def test_batches_are_bounded_and_in_order(tmp_path: Path) -> None:
    lines = (f"({i // 1000}.{i % 1000:03d}) can0 123#{i:08X}\n" for i in range(2 * BATCH + 5))
    (tmp_path / "a.log").write_text("".join(lines))
    log = open_log(tmp_path / "a.log")
    progress, sizes = [], []
    for frames in log:
        progress.append(log.progress)
        sizes.append(len(frames))
    assert sizes == [BATCH, BATCH, 5]
    assert progress == sorted(progress)
    assert 0 < progress[0] < 1


def test_regroup_yields_what_it_has_before_the_damage() -> None:
    def parts() -> Iterable[Frames]:
        yield from (Frames.from_messages(drive(n)) for n in (3, 0, 9, 1))
        raise LogError("damage")

    batches = regroup(parts(), 4)
    assert [len(next(batches)) for _ in range(4)] == [4, 4, 4, 1]
    with pytest.raises(LogError, match="damage"):
        next(batches)


# What is no log


def test_missing_folder_empty_unknown(tmp_path: Path) -> None:
    assert "no such file" in message_of(tmp_path / "missing.blf")
    (tmp_path / "folder.log").mkdir()
    assert "is a folder" in message_of(tmp_path / "folder.log")
    (tmp_path / "empty.asc").touch()
    assert "is empty" in message_of(tmp_path / "empty.asc")
    (tmp_path / "drive.xyz").write_text("x")
    assert ".blf" in message_of(tmp_path / "drive.xyz")


def test_unreadable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "drive.log"
    path.write_text("(0.0) can0 123#\n")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    assert "Permission denied" in message_of(path)


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc", ".csv", ".trc", ".mf4", ".log.gz", ".blf.gz"])
@pytest.mark.parametrize("junk", ["noise", "prose", "blank", "nul"])
def test_what_is_no_log(tmp_path: Path, suffix: str, junk: str) -> None:
    content = {
        "noise": np.random.default_rng(1).bytes(50_000),
        "prose": b"Dear diary,\ntoday I drove a truck.\n",
        "blank": b"\n \n\r\n",
        "nul": bytes(30_000),
    }
    path = tmp_path / f"junk{suffix}"
    path.write_bytes(content[junk])
    message_of(path)


def test_mf4_cut_short(tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    write(tmp_path / "whole.mf4", drive(100))
    raw = (tmp_path / "whole.mf4").read_bytes()
    for cut in (9, 100, len(raw) // 2):
        (tmp_path / "cut.mf4").write_bytes(raw[:cut])
        message_of(tmp_path / "cut.mf4")


# Time


def times(*t: float) -> Frames:
    return Frames.from_messages(can.Message(timestamp=one, arbitration_id=1) for one in t)


@pytest.mark.parametrize("back", [0.1, 0.999, 3600.0])
def test_a_log_is_read_in_the_order_of_the_file(tmp_path: Path, back: float) -> None:
    t = [5000.0, 5001.0, 5001.0 - back, 5002.0]
    write(tmp_path / "a.csv", [can.Message(timestamp=one, arbitration_id=1) for one in t])
    assert read(tmp_path / "a.csv")[1].t.tolist() == t


@pytest.mark.parametrize("batch", [7, 10_000])
def test_a_clock_that_steps_back_again_and_again_is_refused(batch: int) -> None:
    """As where two channels with clocks of their own are in one log."""
    t = np.column_stack([1000 + 0.01 * np.arange(200), 0.01 * np.arange(200)]).ravel()
    check = TimeCheck(Path("a.log"))
    refusal = rf"a.log: time steps back {MAX_STEPS_BACK} times .* first at frame 2, from 1000\.0* s to 0\.0* s"
    batches = [times(*t[start : start + batch]) for start in range(0, len(t), batch)]
    with pytest.raises(LogError, match=refusal):
        deque(map(check.check, batches), maxlen=0)


@pytest.mark.parametrize(("pace", "is_refused"), [(0.0, True), (4e-6, True), (6e-6, False)])
def test_more_frames_in_a_time_than_buses_carry_are_refused(pace: float, is_refused: bool) -> None:
    """Whatever else is in them, the block in which they are judged would not fit into memory."""
    batches = [times(0.0)[np.zeros(1 << 16, np.intp)] for _ in range(20)]
    check = TimeCheck(Path("a.log"))
    refusal = pytest.raises(LogError, match="within 5 s, which no bus carries") if is_refused else nullcontext()
    with refusal:
        for i, batch in enumerate(batches):
            check.check(replace(batch, t=pace * (i * len(batch) + np.arange(len(batch)))))


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf"), 1e17])
def test_times_must_be_numbers_from_zero_on(bad: float) -> None:
    with pytest.raises(LogError, match=r"a.log: frame 3 has the time"):
        TimeCheck(Path("a.log")).check(times(0.0, 0.5, bad))


# Text formats


def asc(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "drive.asc"
    path.write_text(text)
    return path


def test_asc_relative_times_are_added_up(tmp_path: Path) -> None:
    path = asc(
        tmp_path,
        "date Mon Jan 1 10:00:00.000 2024\nbase hex  timestamps relative\nno internal events logged\n"
        "0.000000 Start of measurement\n"
        "0.100000 1  18FEF100x       Rx   d 2 01 02\n"
        "0.100000 1  Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 0.1%\n"
        "0.100000 1  123             Rx   d 1 FF\n",
    )
    log, frames = read(path)
    assert np.allclose(frames.t, [0.1, 0.3])
    assert log.skipped == {"event that is no CAN frame": 1}


def test_asc_lines_that_python_can_drops_are_counted(tmp_path: Path) -> None:
    path = asc(
        tmp_path,
        "base hex  timestamps absolute\n"  # and no line about internal events
        "0.100000 1  18FEF100x       Rx   d 2 01 02\n"
        "0.200000 J1939TP FEE3p 6 0 0 - Rx d 10 00 01 02 03 04 05 06 07 08 09\n"
        "0.300000 1  ErrorFrame\n"
        "0.400000 1  EngineData::EEC1 Rx   d 1 00\n"
        "// a comment\n",
    )
    log, frames = read(path)
    assert len(frames) == 1
    assert sum(log.skipped.values()) == 3
    assert log.skipped["error frame"] == 1
    assert any("J1939TP" in reason for reason in log.skipped)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("0.2 1  123  Rx   d 8 01 02 03\n", "expected 8 data bytes, found 3"),
        ("0.2 1  123  Rx   d 2 01 XX\n", "XX"),
        ("0.2 1  EngineData  Rx   d 2 01 02\n", "EngineData"),
        ("0.2 1  FFF  Rx   d 1 01\n", "expected a CAN id"),
        ("0.2 CANFD 1 Rx 123 1 0 8 64 01\n", "expected 64 data bytes"),
    ],
)
def test_asc_bad_lines_are_named(tmp_path: Path, line: str, reason: str) -> None:
    head = "base hex  timestamps absolute\n\n0.1 1  18FEF100x  Rx   d 2 01 02\n"
    text = message_of(asc(tmp_path, head + 2 * line))  # more than there are frames
    assert f"{tmp_path / 'drive.asc'}:4: " in text
    assert reason in text


@pytest.mark.parametrize("line", ["0.2 1  123  Rx   d 2 01 0", "0.2 1  12", "0.2 1  123  Rx   d 2 01 XX\n0.3 1  12"])
def test_asc_damage_costs_the_lines_that_it_is_in(tmp_path: Path, line: str) -> None:
    head = "base hex  timestamps absolute\n" + "0.1 1  18FEF100x  Rx   d 2 01 02\n" * 5
    log, frames = read(asc(tmp_path, head + line))
    assert len(frames) == 5
    assert log.skipped == {"damaged line (the first is line 7)": 1 + line.count("\n")}


TRC_HEADS = {
    "1.0": ";##########\n",
    "1.1": ";$FILEVERSION=1.1\n;$STARTTIME=43008.920986006946\n",
    "2.0": ";$FILEVERSION=2.0\n;$STARTTIME=43008.920986006946\n;$COLUMNS=N,O,T,I,d,l,D\n",
    "2.1": ";$FILEVERSION=2.1\n;$STARTTIME=43008.920986006946\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n",
}
TRC_LINES = {
    "1.0": ["    1)      1841  00000101  8  00 01 02 03 04 05 06 07", "   12)     48937      0704  1  RTR"],
    "1.1": ["   1)  17535.4  Tx     00000100  3  00 00 0A", "  12)  19980.6  Rx         0704  1  RTR"],
    "2.0": ["  1  17535.400 DT 00000100 Tx 2  00 FF", " 12  48937.600 RR     0704 Rx 1"],
    "2.1": ["  1  17535.400 DT 1  00000100 Tx -  1    07", " 12  48937.600 RR 1      0704 Rx -  1"],
}


@pytest.mark.slow
@pytest.mark.parametrize("version", TRC_HEADS)
@pytest.mark.parametrize("last", [0, 1], ids=["data", "remote"])
@pytest.mark.parametrize("end", ["", "\n", "\r\n"])
def test_trc_is_read_as_python_can_reads_it_whether_or_not_the_last_line_is_ended(
    tmp_path: Path, version: str, last: int, end: str
) -> None:
    path = tmp_path / "drive.trc"
    lines = [TRC_LINES[version][0], TRC_LINES[version][0], TRC_LINES[version][last]]
    path.write_text(TRC_HEADS[version] + "\n".join(lines) + end, newline="")
    log, frames = read(path)
    with can.LogReader(path) as reader:
        messages = list(reader)
    assert len(messages) == 3
    want = Frames.from_messages(m for m in messages if not m.is_remote_frame)
    for field in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(frames, field), getattr(want, field)), field
    assert log.skipped["remote frame"] == last


@pytest.mark.parametrize("version", TRC_HEADS)
def test_trc_a_cut_last_line_is_counted(tmp_path: Path, version: str) -> None:
    path = tmp_path / "drive.trc"
    whole = TRC_HEADS[version] + TRC_LINES[version][0]
    for lost in (1, 2, 6):
        path.write_text(whole + "\n" + TRC_LINES[version][0][:-lost])
        log, frames = read(path)
        assert len(frames) == 1
        assert log.skipped == {f"damaged line (the first is line {whole.count(chr(10)) + 2})": 1}


@pytest.mark.parametrize("tail", ["", "  Length = 1704 BitCount = 11", "  Length = 17"])
def test_asc_a_last_line_that_parses_needs_no_line_break(tmp_path: Path, tail: str) -> None:
    _, frames = read(asc(tmp_path, "base hex  timestamps absolute\n0.1 1  18FEF100x  Rx   d 2 01 02" + tail))
    assert bytes(frames.data[0, :2]) == b"\x01\x02"


@pytest.mark.parametrize(("byte", "whole"), [("255", True), ("25", False), ("2", False)])
def test_asc_a_decimal_byte_at_the_end_may_lack_digits(tmp_path: Path, byte: str, whole: bool) -> None:
    path = asc(tmp_path, f"base dec  timestamps absolute\n0.1 1  100  Rx   d 2 01 {byte}")
    if whole:
        assert len(read(path)[1]) == 1
    else:
        assert "end it with a line break" in message_of(path)


def test_csv_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Some prose\n1,2\n")
    assert "expected the header" in message_of(tmp_path / "a.csv")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_damaged_text_is_read_or_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    write(path, drive(40))
    raw = path.read_bytes()
    assert_read_or_refused(path, raw, np.random.default_rng(2), rounds=300)


def test_a_request_to_transmit_is_no_frame_on_the_bus(tmp_path: Path) -> None:
    head = "base hex  timestamps absolute\n\n0.1 1  123  Tx   d 2 01 02\n"
    log = open_log(asc(tmp_path, head + "0.2 1  123  TxRq   d 2 01 02\n0.3 1  123  Tx   d 2 01 02\n"))
    assert sum(len(frames) for frames in log) == 2
    assert log.skipped == {"request to transmit": 1}


@pytest.mark.parametrize("end", ["", ";"])
def test_trc_of_version_1_2_is_read(tmp_path: Path, end: str) -> None:
    path = tmp_path / "drive.trc"
    lines = "   1)   1059.900 1  Rx        0300 7 00 00 00 00 04 00 00\n   2)   1283.231 1  Rx    18FEF100 1 A5\n"
    path.write_text(f";$FILEVERSION=1.2\n;$STARTTIME=39878.6772258947{end}\n;\n{lines}")
    frames = Frames.concatenate(list(open_log(path)))
    assert [bytes(message.data)[0] for message in frames.messages()] == [0, 0xA5]
    assert float(np.diff(frames.t)[0]) == pytest.approx(0.223331, abs=1e-5)


def test_error_lines_of_trc_1_0_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "drive.trc"
    lines = "   1)   1841  0001  2  00 01\n   2)   1842  0008  4  ERROR 00 19 08 08\n   3)   1843  0001  1  05\n"
    path.write_text(f";##########\n{lines}")
    log = open_log(path)
    assert sum(len(frames) for frames in log) == 2
    assert log.skipped == {"error frame": 1}


@pytest.mark.parametrize(
    ("name", "content", "right"),
    [
        ("drive.log", gzip.compress(b"(1.0) can0 18FEF100#00\n", mtime=0), "drive.log.gz"),
        ("drive.asc", b"LOGG" + bytes(200), "drive.blf"),
        ("drive.blf", b"MDF     4.10    ", "drive.mf4"),
        ("drive.log", b"date Tue Nov 14 10:13:20 pm 2023\nbase hex  timestamps absolute\n", "drive.asc"),
        ("drive.csv", b";$FILEVERSION=2.1\n", "drive.trc"),
        ("drive.csv", b"(1.000000) can0 18FEF100#00\n", "drive.log"),
    ],
)
def test_a_log_with_the_suffix_of_another_format_is_named(
    tmp_path: Path, name: str, content: bytes, right: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError, match=f"{name}: begins as .* rename it to {right}$"):
        open_log(path)
