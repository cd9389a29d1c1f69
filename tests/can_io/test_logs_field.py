"""Logs as other programs write them: read, or refused in a sentence that is true."""

import gzip
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mdf_files import Recorded, Style, mdf
from project_paths import TESTS

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.logs import Log, gvret_line, mdf2csv_line, open_log
from estimator.can_io.logs import crtd as crtd_log
from estimator.can_io.logs.line_layout import BadLineError, Layout
from estimator.can_io.logs.mdf import unpacking
from estimator.can_io.logs.time_check import TimeCheck
from estimator.errors import LogError

LOGS = TESTS / "field_logs"
SPEED = 0x18FEF100 | EXTENDED


def read(path: Path) -> tuple[Log, Frames]:
    log = open_log(path)
    return log, Frames.concatenate(list(log))


def written(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path: Path) -> str:
    with pytest.raises(LogError) as caught:
        list(open_log(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def payload(k: int) -> bytes:
    """What the k-th frame of most logs in the folder holds."""
    return bytes([0xF3, 3 * k & 0xFF, 0x28, 0, 0, 0, 0, 0xFF])


@pytest.mark.parametrize(
    ("name", "first", "skipped"),
    [
        ("gvret.csv", 166.064, {}),
        ("gvret_old.csv", None, {}),
        ("canedge_mdf2csv.csv", 1.7e9, {}),
        ("ovms.crtd", 1.7e9, {}),
        ("candump_tA.log", 1.7e9, {}),
        ("candump_cut.log", 1.7e9, {"damaged line (the first is line 201)": 1}),
        ("asc_negative_times.asc", None, {}),
        ("blf_no_containers.blf", 1_714_730_400.0, {}),
        ("mf4_virtual_ide.mf4", 1.7e9, {}),
        ("mf4_20_groups.mf4", 1.7e9, {}),
        ("mf4_zstd.mf4", 1_795_767_031.385569, {}),
    ],
)
def test_two_hundred_frames_are_read(name: str, first: float | None, skipped: dict[str, int]) -> None:
    log, frames = read(LOGS / name)
    assert log.skipped == skipped
    assert (frames.ident == SPEED).all()
    assert [bytes(row) for row in frames.data] == [payload(k) for k in range(200)]
    assert frames.t[0] >= 0
    if first is not None:
        assert frames.t[0] == pytest.approx(first, abs=1e-6)
    assert np.diff(frames.t) == pytest.approx(0.1, abs=2e-6)


def test_gvret_with_and_without_a_direction() -> None:
    _, frames = read(LOGS / "gvret_with_dir.csv")
    assert frames.t.tolist() == [166.064, 166.084]
    assert frames.ident.tolist() == [0x0CF00400 | EXTENDED, SPEED]
    assert bytes(frames.data[0]) == bytes.fromhex("F07D859B0BFFFF85")
    _, frames = read(LOGS / "gvret_without_dir.csv")
    assert frames.t[1] - frames.t[0] == pytest.approx(1e-3)
    assert frames.ident.tolist() == [0x257, 0x132]
    assert frames.length.tolist() == [8, 4]


def test_crtd_tells_ids_of_11_and_29_bits_and_passes_over_comments(tmp_path: Path) -> None:
    _, frames = read(LOGS / "monitor.crtd")
    assert frames.ident.tolist() == [0x0CF00400 | EXTENDED, 0x257]
    assert frames.t.tolist() == [1542473901.020305, 1542473901.040305]
    _, older = read(written(tmp_path / "older.txt", "1.5 R11 257 01 02\n1.6 T29 257\n1.7 CEV started\n"))
    assert older.ident.tolist() == [0x257, 0x257 | EXTENDED]
    assert older.length.tolist() == [2, 0]


def test_crtd_and_gvret_are_read_by_bus_and_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.crtd.gz"
    path.write_bytes(gzip.compress(b"1.0 1R11 100 01\n1.1 2R11 200 02\n"))
    assert read(path)[0].channels.counts == {"1": 1, "2": 1}
    assert len(Frames.concatenate(list(open_log(path, ["2"])))) == 1


@pytest.mark.parametrize("columns", ["", ";ESI;RTR"])
def test_mdf2csv_is_read_by_the_names_of_its_columns(tmp_path: Path, columns: str) -> None:
    more = ";0;1" if columns else ""
    head = f"TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS{columns};DataBytes\n"
    whole = "1.5;1;123;0;8;8;0;0;0" + (";0;0" if columns else "") + ";0011223344556677\n"
    log, frames = read(written(tmp_path / "a.csv", head + whole + (f"1.6;1;123;0;2;2;0;0;0{more};\n" if more else "")))
    assert bytes(frames.data[0]) == bytes.fromhex("0011223344556677")
    assert log.skipped == ({"remote frame": 1} if more else {})


@st.composite
def some_frames(draw: st.DrawFn) -> list[tuple[int, int, bool, bytes]]:
    """Times [us], ids, whether they have 29 bits, payloads."""
    frames, t = [], draw(st.integers(-(10**12), 10**12))
    for _ in range(draw(st.integers(1, 30))):
        t += draw(st.integers(0, 10**6))
        extended = draw(st.booleans())
        ident = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
        frames.append((t, ident, extended, draw(st.binary(max_size=8))))
    return frames


def as_gvret(t: int, ident: int, extended: bool, data: bytes) -> str:
    return f"{t},{ident:08X},{str(extended).lower()},Rx,0,{len(data)},{''.join(f'{byte:02X},' for byte in data)}\n"


def as_crtd(t: int, ident: int, extended: bool, data: bytes) -> str:
    return f"{t // 10**6}.{t % 10**6:06d} 1R{29 if extended else 11} {ident:X} {data.hex(' ')}".rstrip() + "\n"


def as_mdf2csv(t: int, ident: int, extended: bool, data: bytes) -> str:
    size = len(data)
    return f"{t // 10**6}.{t % 10**6:06d};1;{ident:X};{int(extended)};{size};{size};0;0;0;{data.hex().upper()}\n"


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(frames=some_frames(), kind=st.sampled_from(["gvret", "crtd", "mdf2csv"]))
def test_every_value_comes_back(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[int, int, bool, bytes]], kind: str
) -> None:
    folder = tmp_path_factory.mktemp("log")
    if kind != "gvret":
        frames = [(t + 2 * 10**12, *rest) for t, *rest in frames]
    head = {
        "gvret": "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n",
        "crtd": "0.0 CXX a comment\n",
        "mdf2csv": "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n",
    }[kind]
    line = {"gvret": as_gvret, "crtd": as_crtd, "mdf2csv": as_mdf2csv}[kind]
    suffix = ".crtd" if kind == "crtd" else ".csv"
    _, back = read(written(folder / f"log{suffix}", head + "".join(line(*frame) for frame in frames)))
    moved = back.t[0] - frames[0][0] / 1e6
    assert back.t - moved == pytest.approx([t / 1e6 for t, *_ in frames], abs=1e-6)
    assert moved == 0 if frames[0][0] >= 0 else moved == round(moved, 6) > 0
    assert back.ident.tolist() == [ident | EXTENDED * extended for _, ident, extended, _ in frames]
    found = [bytes(row[:length]) for row, length in zip(back.data, back.length, strict=True)]
    assert found == [data for *_, data in frames]


MDF2CSV = mdf2csv_line.pattern(b"TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes")


@pytest.mark.parametrize(
    ("parse", "line"),
    [
        (gvret_line.layout, b"1,123,false,Rx,0,8,00,11"),
        (gvret_line.layout, b"1,FFF,false,Rx,0,0,"),
        (gvret_line.layout, b"1,123,maybe,Rx,0,0,"),
        (gvret_line.layout, b"1,123,true,0,65," + b"00," * 65),
        (crtd_log.layout, b"1.0 1R11 FFF 00"),
        (crtd_log.layout, b"1.0 1R11 123 00 0"),
        (crtd_log.layout, b"1.0 1R29 123" + b" 00" * 9),
        (crtd_log.layout, b"1.0 1R12 123 00"),
        (lambda line: mdf2csv_line.layout(line, MDF2CSV), b"1.0;1;123;0;8;8;0;0;0;0011"),
        (lambda line: mdf2csv_line.layout(line, MDF2CSV), b"1.0;1;FFF;0;0;0;0;0;0;"),
        (lambda line: mdf2csv_line.layout(line, MDF2CSV), b"1.0;1;123;0;1;1;0;0;0;0G"),
    ],
)
def test_lines_without_a_frame_are_refused(parse: Callable[[bytes], Layout], line: bytes) -> None:
    with pytest.raises(BadLineError):
        parse(line)


# candump


def test_candump_explanations_colours_and_zeros_cost_no_frame(tmp_path: Path) -> None:
    text = (
        b"\x1b[32m (1.000000)  can0  \x1b[0m 18FEF100   [2]  00 11\n"
        b" (1.100000)  can0  20000080   [8]  00 00 00 00 00 00 00 00   ERRORFRAME\n"
        b"\tbus-error\n"
        b"\terror-counter-tx-rx{{128}{0}}\n"
        b" (1.200000)  can0  18FEF100   [2]  00 12\n"
        + bytes(100_000)
        + b" (1.300000)  can0  18FEF100   [2]  00 13\n (1.400000)  can0  18FEF100   [2]  00 14\n"
    )
    log, frames = read(written(tmp_path / "a.log", text))
    assert frames.data[:, 1].tolist() == [0x11, 0x12, 0x14]
    assert log.skipped == {"error frame": 1, "damaged line (the first is line 6)": 1}


def test_candump_without_times_is_refused_with_how_to_record() -> None:
    message = refusal(LOGS / "candump_without_time.log")
    assert message.endswith("without which no acceleration is known; record with candump -l or -ta")


@pytest.mark.parametrize("date", ["2023-02-30 22:13", "0000-01-01 00:00"])
def test_a_date_that_is_none_is_refused(tmp_path: Path, date: str) -> None:
    assert "date" in refusal(written(tmp_path / "a.log", f" ({date}:20.5)  can0  123   [1]  00\n"))


def test_differences_in_time_are_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lines = [f" (000.{step:06d})  can0  123   [1]  00\n" for step in rng.integers(100, 20_000, 2000)]
    message = refusal(written(tmp_path / "a.log", "".join(lines)))
    assert "times do not rise" in message
    assert "candump -td" in message


@pytest.mark.parametrize(("power", "unit"), [(3, "milliseconds"), (6, "microseconds")])
def test_an_epoch_in_a_finer_unit_is_named(power: int, unit: str) -> None:
    t = (1_767_600_000.0 + np.arange(2000.0)) * 10**power
    n = len(t)
    frames = Frames(t, np.zeros(n, np.uint32), np.full(n, 8, np.uint8), np.zeros((n, 8), np.uint8))
    with pytest.raises(LogError, match=f"if the times of the log are {unit}, divide them by"):
        TimeCheck(Path("a.csv")).check(frames)


def test_times_in_microseconds_are_named() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.0, 0.006, 2000))
    zeros = np.zeros((2000, 8), np.uint8)
    frames = [Frames(time, np.ones(2000, np.uint32), np.full(2000, 8, np.uint8), zeros) for time in (t, 1e6 * t)]
    TimeCheck(Path("a.log")).check(frames[0])
    with pytest.raises(LogError, match="if the times are microseconds, divide them by 1,000,000"):
        TimeCheck(Path("a.log")).check(frames[1])
    late = np.where(np.arange(2000) < 1000, t, 1.7e9 + t)  # a clock that was set on the way
    TimeCheck(Path("a.log")).check(Frames(late, frames[0].ident, frames[0].length, zeros))


@pytest.mark.parametrize("late", [0.0, 0.9])
def test_frames_of_two_channels_that_come_late_are_no_differences(late: float) -> None:
    check = TimeCheck(Path("a.log"))
    t = np.arange(0.0, 100.0, 0.05)
    t[::2] -= late
    frames = Frames(np.maximum(t, 0.0), np.zeros(len(t), np.uint32), np.zeros(len(t), np.uint8), np.zeros((len(t), 8)))
    check.check(frames)
    check.finish()


# .asc

ASC = "date Tue Nov 14 10:13:20.000 pm 2023\nbase hex  timestamps absolute\nno internal events logged\n"


@pytest.mark.parametrize("order", ["utf-16-le", "utf-16-be", "utf-8"])
@pytest.mark.parametrize("point", [".", ","])
def test_asc_in_utf_16_and_with_commas_in_the_times(tmp_path: Path, order: str, point: str) -> None:
    lines = "".join(f"   {k // 10}{point}{k % 10}00000 1  18FEF100x  Rx   d 2 01 {k % 256:02X}\n" for k in range(500))
    odd = f"   50{point}000000 1  18FEF100x  Rx   r\n"  # which the reader of python-can parses
    raw = "\ufeff".encode(order) + (ASC + lines + odd).encode(order)
    log, frames = read(written(tmp_path / "a.asc", raw))
    assert frames.t.tolist() == [k / 10 for k in range(500)]
    assert frames.data[:, 1].tolist() == [k % 256 for k in range(500)]
    assert log.skipped == {"remote frame": 1}


def test_a_decoded_table_is_no_log_and_the_message_shows_the_options() -> None:
    path = LOGS / "decoded.csv"
    assert refusal(path) == (
        f"{path}: a table of decoded values, not a log of frames (its columns: 'time,speed_kmh,power_kw,altitude_m'); "
        'give its columns to estimate, inspect, check, diagnose or fleet: --map speed="COLUMN [km/h]" '
        '--map power="COLUMN [kW]"'
    )


FRAME = "1767600000.01,0xcf00400,1,0,0,8,P/+BwBL///8="
PYTHON_CAN = "timestamp,arbitration_id,extended,remote,error,dlc,data"


@pytest.mark.parametrize(
    ("name", "lines", "said"),
    [
        ("a.csv", [PYTHON_CAN.replace(",", ";"), FRAME.replace(",", ";")], "a log of frames without commas between"),
        ("a.csv", [FRAME, FRAME], f"begins with a frame; put the header '{PYTHON_CAN}' above it"),
        ("a.csv", ["166064000,18FEF100,true,Rx,0,2,F3,00,"], "begins with a frame; put the header 'Time Stamp,ID,"),
        ("a.asc", [PYTHON_CAN, FRAME], "begins as a .csv file does; rename it to a.csv"),
        ("a.asc", ["t,v,P", "0,1,2"], "begins as a .csv file does; rename it to a.csv"),
    ],
)
def test_a_log_in_other_columns_is_told_from_a_table(name: str, lines: list[str], said: str, tmp_path: Path) -> None:
    assert said in refusal(written(tmp_path / name, "\n".join(lines) + "\n"))


def test_a_trace_of_another_program_is_told_from_one_of_pcan_view(tmp_path: Path) -> None:
    text = "@ TEXT @ 3 @ 7 @ 512 @ 0 @\n00.001 1 123 8 01 02 03 04 05 06 07 08\n"
    message = refusal(written(tmp_path / "a.trc", text))
    assert "expected a trace of PEAK's PCAN-View" in message
    assert message.endswith("export it as .asc or .blf")


def test_what_no_converter_reads_is_not_sent_to_one(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="export it as one of them") as caught:
        open_log(written(tmp_path / "monitor.txt", "Time\tID\tD0\n1\t257\t00\n"))
    assert "logconvert" not in str(caught.value)


def test_a_line_without_end_is_refused_before_it_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.crtd.gz"
    path.write_bytes(gzip.compress(b"1.0 1R11 100 01\n" + b"x" * (1 << 24)))
    log = open_log(path)
    with pytest.raises(LogError, match="a line of over 16384 bytes"):
        list(log)
    assert log.progress < 0.9


def test_asc_transport_lines_are_counted_by_their_name() -> None:
    log, frames = read(LOGS / "asc_j1939tp.asc")
    assert len(frames) == 196
    assert log.skipped == {"J1939TP line (a transport protocol message that CANoe put together)": 4}


# .blf


def test_blf_at_an_object_of_0_bytes_advises_no_converter() -> None:
    message = refusal(LOGS / "blf_object_of_size_0.blf")
    assert "an object of 0 bytes" in message
    assert "after 100 frames" in message
    assert "logconvert" not in message


def test_blf_objects_before_containers_are_read(tmp_path: Path) -> None:
    path = tmp_path / "b.blf"
    with can.BLFWriter(path) as log:
        log(can.Message(timestamp=1_714_730_420.0, arbitration_id=0x18FEF100, data=bytes(8), channel=0))
    single = (LOGS / "blf_no_containers.blf").read_bytes()
    _, frames = read(written(tmp_path / "both.blf", single + path.read_bytes()[144:]))
    assert len(frames) == 201


# .mf4


def test_mf4_records_marked_as_invalid_are_left_out_and_counted() -> None:
    log, frames = read(LOGS / "mf4_invalid_records.mf4")
    assert len(frames) == 150
    assert log.skipped == {"frame marked as invalid": 50}
    assert set(np.round(np.diff(frames.t), 3)) <= {0.1, 0.2}


def repacked(folder: Path, compression: int) -> Path:
    """The frames of a log, as asammdf packs them."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(LOGS / "mf4_zstd.mf4") as file:
        return Path(file.save(folder / "a.mf4", compression=compression))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("compression", [3, 4, 5, 6], ids=["zstd", "zstd transposed", "lz4", "lz4 transposed"])
def test_mf4_packed_as_version_4_30_allows(tmp_path: Path, compression: int) -> None:
    _, want = read(LOGS / "mf4_zstd.mf4")
    _, frames = read(repacked(tmp_path, compression))
    assert frames.t.tolist() == want.t.tolist()
    assert np.array_equal(frames.data, want.data)


def test_mf4_names_the_extra_where_a_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "compression" if sys.version_info >= (3, 14) else "backports"
    monkeypatch.setitem(sys.modules, f"{name}.zstd", None)
    monkeypatch.delattr(importlib.import_module(name), "zstd", raising=False)
    message = refusal(LOGS / "mf4_zstd.mf4")
    assert "Zstandard" in message
    assert message.endswith('pip install "roadload[mf4]", in a clone .venv/bin/pip install -e ".[mf4]"')
    assert "copy it anew" not in message


@pytest.mark.parametrize("method", [unpacking.ZSTANDARD, unpacking.LZ4])
def test_packed_data_give_no_more_than_they_may(method: int) -> None:
    zstd, lz4 = pytest.importorskip("backports.zstd"), pytest.importorskip("lz4.frame")
    packed = (zstd if method == unpacking.ZSTANDARD else lz4).compress(bytes(1 << 26))
    found, fault = unpacking.unpack(method, packed, 1 << 26, 1000)
    assert len(found) <= 1001
    assert fault == "do not end"
    assert unpacking.unpack(method, packed[:-1], 1 << 26, 1 << 26)[1]
    assert unpacking.unpack(method, b"\0" * 50, 50, 50) == (b"", "are damaged")


def test_mf4_with_more_streams_than_can_be_held_is_refused_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("estimator.can_io.logs.mf4.MAX_STREAMS", 19)
    message = refusal(LOGS / "mf4_20_groups.mf4")
    assert "20 streams of CAN frames, of which 19 can be read at once" in message
    assert "copy it anew" not in message


def test_mf4_of_a_virtual_channel_that_counts_is_refused_as_that(tmp_path: Path) -> None:
    raw = bytearray((LOGS / "mf4_virtual_ide.mf4").read_bytes())
    factor = raw.index(np.array([1.0, 0.0]).tobytes()) + 8  # of the first conversion to a constant
    raw[factor : factor + 8] = np.array([1.0]).tobytes()
    message = refusal(written(tmp_path / "a.mf4", bytes(raw)))
    assert "virtual channel" in message
    assert message.endswith("export the log as .blf or .asc")


@pytest.mark.parametrize("is_sorted", [True, False])
@pytest.mark.parametrize("payload", ["fixed", "values"])
def test_mf4_invalid_records_of_any_layout_are_left_out(tmp_path: Path, is_sorted: bool, payload: str) -> None:
    frames = [Recorded(t=0.1 * k, data=bytes([k]), valid=k % 4 > 0) for k in range(40)]
    style = Style(is_sorted=is_sorted, payload=payload, width=8, has_marks=True)
    log, read_back = read(written(tmp_path / "a.mf4", mdf(frames, style)))
    assert read_back.data[:, 0].tolist() == [k for k in range(40) if k % 4]
    assert log.skipped == {"frame marked as invalid": 10}
    assert log.channels.counts == {"1": 30}
