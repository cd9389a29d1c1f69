"""The line reader of .asc, candump and .csv logs: digits, times and payloads as other programs convert them."""

import base64
import tempfile
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.logs import open_log
from estimator.can_io.logs.csv_columns import read_usual
from estimator.can_io.logs.digits import decimal, hexadecimal, nibbles
from estimator.can_io.logs.line_table import MAX_LAYOUTS
from estimator.errors import LogError

ANY = st.characters(min_codepoint=1, max_codepoint=255)


def table(texts: list[str]) -> np.ndarray:
    return np.array([list(text.encode("latin-1")) for text in texts], np.uint8)


def texts(alphabet: str, most: int) -> st.SearchStrategy[list[str]]:
    """Texts of one length, most of whose characters are digits of the alphabet."""
    character = st.sampled_from(alphabet) | st.sampled_from(alphabet) | ANY
    return st.integers(1, most).flatmap(
        lambda n: st.lists(st.text(character, min_size=n, max_size=n), min_size=1, max_size=8)
    )


@given(texts("0123456789", 18))
def test_decimal_digits_are_converted_as_int_converts_them(given_texts: list[str]) -> None:
    numbers, valid = decimal(table(given_texts))
    for text, number, good in zip(given_texts, numbers.tolist(), valid.tolist(), strict=True):
        assert good == all(c in "0123456789" for c in text)
        assert not good or number == int(text)


@given(texts("0123456789abcdefABCDEF", 8))
def test_hexadecimal_digits_are_converted_as_int_converts_them(given_texts: list[str]) -> None:
    numbers, valid = hexadecimal(table(given_texts))
    _, also_valid = nibbles(table(given_texts))
    assert valid.tolist() == also_valid.tolist()
    for text, number, good in zip(given_texts, numbers.tolist(), valid.tolist(), strict=True):
        assert good == all(c in "0123456789abcdefABCDEF" for c in text)
        assert not good or number == int(text, 16)


def read(suffix: str, text: str) -> Frames:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"drive{suffix}")
        path.write_text(text)
        return Frames.concatenate(list(open_log(path)))


@st.composite
def csv_line(draw: st.DrawFn) -> tuple[str, float, int, bytes]:
    seconds = str(draw(st.integers(0, 10 ** draw(st.integers(1, 10)) - 1)))
    fraction = draw(st.text("0123456789", min_size=1, max_size=18))
    extended = draw(st.booleans())
    ident = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    data = draw(st.binary(max_size=8))
    payload = base64.b64encode(data).decode()
    time = f"{seconds}.{fraction}"
    return f"{time},0x{ident:x},{extended:d},0,0,{len(data)},{payload}", float(time), ident | EXTENDED * extended, data


@settings(deadline=None, max_examples=40)
@given(st.lists(csv_line(), min_size=1, max_size=30))
def test_csv_values_are_exact_to_the_last_bit(lines: list[tuple[str, float, int, bytes]]) -> None:
    lines.sort(key=lambda line: line[1])
    text = "timestamp,arbitration_id,extended,remote,error,dlc,data\n" + "".join(line[0] + "\n" for line in lines)
    frames = read(".csv", text)
    assert frames.t.tolist() == [line[1] for line in lines]
    assert frames.ident.tolist() == [line[2] for line in lines]
    assert [bytes(d[:n]) for d, n in zip(frames.data, frames.length, strict=True)] == [line[3] for line in lines]


@st.composite
def odd_csv_line(draw: st.DrawFn) -> str:
    """A line that is nearly one of python-can: an unusual field, or some characters that are others."""
    line, _, _, _ = draw(csv_line())
    fields = line.split(",")
    place = draw(st.integers(0, len(fields)))
    if place < len(fields):
        short = draw(
            st.sampled_from(["", "0", "1", "9", "1e-05", "12345678901234.5", "1.", ".5", "0x", "0X1", "0x123456789"])
        )
        fields[place] = draw(st.sampled_from([fields[place], short, fields[place] + "0", "=" + fields[place]]))
    text = list(",".join(fields))
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(text)))
        text[at : at + draw(st.integers(0, 1))] = draw(st.sampled_from([*"0aF=,.x/+\r :", "\xff", "\n", ""]))
    return "".join(text)


def outcome(path: Path) -> tuple[list[float], list[int], list[bytes], dict[str, int], str]:
    """All that a reader says about a log."""
    parts: list[Frames] = []
    log, error = open_log(path), ""
    try:
        parts.extend(log)
    except LogError as found:
        error = str(found)
    frames = Frames.concatenate(parts)
    payloads = [bytes(d[:n]) for d, n in zip(frames.data, frames.length, strict=True)]
    return frames.t.tolist(), frames.ident.tolist(), payloads, dict(log.skipped), error


@pytest.mark.slow
@settings(deadline=None, max_examples=80)
@given(
    st.lists(csv_line().map(lambda line: line[0]) | odd_csv_line(), min_size=1, max_size=6),
    st.sampled_from(["\n", "\r\n"]),
    st.booleans(),
)
def test_usual_csv_lines_are_read_as_by_the_grammar(lines: list[str], end: str, is_ended: bool) -> None:
    text = end.join(["timestamp,arbitration_id,extended,remote,error,dlc,data", *lines]) + end * is_ended
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder, "drive.csv")
        path.write_bytes(text.encode("latin-1"))
        found = outcome(path)
        patch.setattr("estimator.can_io.logs.csv_text.CsvLog.usual", None)
        assert found == outcome(path)


def test_lines_as_python_can_writes_them_are_usual() -> None:
    lines = [
        "1700000000.0313795,0x18f00503,1,0,0,8,////f/////8=",
        "0.5,0x7ff,0,0,0,0,",
        "123456789012.25,0x0,1,0,0,1,/w==",
    ]
    text = b"".join(line.encode() + b"\n" for line in lines)
    buffer = np.frombuffer(bytes(16) + text + bytes(32), np.uint8)
    ends = np.flatnonzero(buffer == ord("\n"))
    rows, frames = read_usual(buffer, np.append(16, ends[:-1] + 1), ends)
    assert rows.tolist() == [0, 1, 2]
    assert frames.t.tolist() == [float(line.split(",")[0]) for line in lines]


@st.composite
def asc_line(draw: st.DrawFn) -> str:
    """An event without its time, as CANoe, CANalyzer, python-can and people write them."""
    extended = draw(st.booleans())
    ident = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    name = f"{ident:{draw(st.sampled_from('xX'))}}{'x' * extended}"
    way = draw(st.sampled_from(["Rx", "Tx"]))
    data = draw(st.binary(max_size=8))
    digits = data.hex(" ").upper()
    tail = draw(st.sampled_from(["", "  Length = 215910 BitCount = 111 ID = 419328000x", " ", "   BE EF"]))
    form = draw(st.sampled_from(["classic"] * 6 + ["fd", "remote", "error", "bus"]))
    if form == "fd":
        length = draw(st.sampled_from([1, 8, 12, 64]))
        data = draw(st.binary(min_size=length, max_size=length))
        code = can.util.len2dlc(length)
        return f"CANFD   1 {way}  {name}   1 0 {code:x} {length:2d} {data.hex(' ')}   130000  130 203000 0 0 46500250"
    if form == "remote":
        return f"1  {name}  {way}   r"
    if form == "error":
        return "1  ErrorFrame"
    if form == "bus":
        return "1  Statistic: D 0 R 0 XD 1 XR 0 E 0 O 0 B 0.00%"
    return f"1  {name}{' ' * draw(st.integers(1, 8))}{way}   d {len(data)} {digits}{tail}"


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(st.lists(asc_line(), min_size=1, max_size=30), st.integers(0, 10**10))
def test_asc_is_read_as_python_can_reads_it(events: list[str], start: int) -> None:
    first = "1  18FEF100x       Rx   d 8 00 01 02 03 04 05 06 07"
    lines = [f"{(start + 1237 * i) / 1e6:11.6f} {event}\n" for i, event in enumerate([first, *events])]
    text = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\nno internal events logged\n"
    text += "".join(lines)
    frames = read(".asc", text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.asc")
        path.write_text(text)
        with can.LogReader(path) as reader:
            messages = [m for m in reader if not m.is_error_frame and not m.is_remote_frame]
    expected = Frames.from_messages(messages)
    assert frames.t.tolist() == expected.t.tolist()
    assert frames.ident.tolist() == expected.ident.tolist()
    for i, message in enumerate(messages):
        assert bytes(frames.data[i, : frames.length[i]]) == bytes(message.data)


def test_lines_of_one_length_and_of_more_layouts_than_are_read_together() -> None:
    rng, width = np.random.default_rng(1), 60
    lines, expected = [], []
    for i in range(4 * MAX_LAYOUTS):
        before, behind, size = " " * int(rng.integers(9)), " " * int(rng.integers(1, 9)), int(rng.integers(9))
        ident, data = int(rng.integers(1 << 29)), rng.bytes(size)
        line = f"{before}({1000 + i}.{i:03d}) can0{behind}{ident:08X}#{data.hex()}"
        lines.append(line + " " * (width - len(line)) + "\n")
        expected.append((float(f"{1000 + i}.{i:03d}"), ident | EXTENDED, data))
    lines.insert(200, f"(1200.5) can0 {0x20000004:08X}#00".ljust(width) + "\n")  # an error frame
    frames = read(".log", "".join(lines))
    found = zip(frames.t.tolist(), frames.ident.tolist(), frames.length.tolist(), frames.data, strict=True)
    assert [(t, ident, data[:length].tobytes()) for t, ident, length, data in found] == expected
    lines[199:199] = [f"(1200.5) can0 {0x40000000:08X}#00".ljust(width) + "\n"] * 5
    assert len(read(".log", "".join(lines))) == len(expected)  # two lines in a hundred
    with pytest.raises(LogError, match=r"drive\.log:200: expected a CAN id"):
        read(".log", "".join(lines[:199] + lines[199:200] * 6))


@pytest.mark.parametrize("suffix", [".asc", ".csv"])
def test_lines_across_pieces_of_a_file_are_read_once(suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("estimator.can_io.logs.line_log.CHUNK", 37)
    rows = [((100 + i) / 100, i.to_bytes(3, "big")) for i in range(200)]
    if suffix == ".asc":
        head = "base hex  timestamps absolute\n"
        lines = [f" {t:.6f} 1  18FEF100x  Rx   d 3 {data.hex(' ')}\n" for t, data in rows]
    else:
        head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
        lines = [f"{t:.6f},0x18fef100,1,0,0,3,{base64.b64encode(data).decode()}\n" for t, data in rows]
    frames = read(suffix, head + "".join(lines))
    assert frames.t.tolist() == [t for t, _ in rows]
    assert [bytes(row[:3]) for row in frames.data] == [data for _, data in rows]


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".trc"])
def test_a_carriage_return_inside_a_line_ends_no_line(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    with can.Logger(path) as log:
        for i in range(3):
            log(can.Message(timestamp=float(i), arbitration_id=0x18FEF100, data=bytes(8)))
    raw = path.read_bytes()
    for place in range(raw.rstrip().rindex(b"\n") + 1, len(raw)):
        path.write_bytes(raw[:place] + b"\r" + raw[place + 1 :])
        try:
            assert sum(map(len, open_log(path))) >= 2
        except LogError as error:
            assert f"{path}:{raw.count(bytes([10]))}: " in str(error)  # noqa: PT017


def trc_lines(version: str, start: int, count: int, rng: np.random.Generator) -> list[str]:
    """Lines of traffic as PCAN programs write them, numbered on from a start."""
    lines, t = [], 0.0
    for number in range(start, start + count):
        t += float(rng.choice([0.0, 0.1, 3.7, 1000.3]))
        extended, length = rng.random() < 0.7, int(rng.choice([8, 8, 8, 0, 1, 5]))
        ident = f"{rng.integers(1 << (29 if extended else 11)):0{8 if extended else 4}X}"
        data = rng.bytes(length).hex(" ").upper()
        kind = str(rng.choice(["data"] * 9 + ["remote", "error", "comment"]))
        if kind == "comment":
            lines.append("; a remark")
        elif version == "1.0":
            tail = {"data": f"{ident:>8}  {length}  {data}", "remote": f"{ident:>8}  {length}  RTR"}
            lines.append(f"{number:6}) {int(t * 10):9}  " + tail.get(kind, "FFFFFFFF  4  00 00 00 08"))
        elif version in ("1.1", "1.3"):
            bus = f"{1 + int(ident, 16) % 2}  " if version == "1.3" else ""  # no identifier on two channels
            gap = "-  " if version == "1.3" else ""
            tail = {"data": f"Rx  {ident:>8}  {gap}{length}  {data}", "remote": f"Tx  {ident:>8}  {gap}{length}  RTR"}
            lines.append(f"{number:6}) {t:11.1f}  {bus}" + tail.get(kind, "Warng  FFFFFFFF  4  00 00 00 08"))
        else:
            form = str(rng.choice(["DT"] * 5 + ["FD", "FB"])) if kind == "data" else "RR"
            bus = "1 " if version == "2.1" else ""
            if version == "2.0" and form in ("FD", "FB"):
                data, length = rng.bytes(12).hex(" "), 12
            gap = "-  " if version == "2.1" else ""
            tail = f"{bus}{ident:>8} Rx {gap}{length:<2} {data if kind == 'data' else ''}"
            lines.append(f"{number:7} {t:13.3f} " + (f"{form} {tail}" if kind != "error" else "ST Rx  00 00 00 08"))
    return lines


@pytest.mark.slow
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("version", ["1.0", "1.1", "1.3", "2.0", "2.1"])
def test_trc_is_read_as_python_can_reads_it(version: str, end: str) -> None:
    columns = {"2.0": "N,O,T,I,d,l,D", "2.1": "N,O,T,B,I,d,R,L,D"}.get(version)
    head = [";$FILEVERSION=" + version, ";$STARTTIME=43008.920986006946"] * (version != "1.0")
    head += [f";$COLUMNS={columns}"] * (columns is not None) + [";   a remark"]
    for seed, start in enumerate((1, 90, 99_990)):
        rng = np.random.default_rng(seed)
        text = end.join([*head, *trc_lines(version, start, 400, rng)]) + end
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "drive.trc")
            path.write_text(text, newline="")
            log = open_log(path)
            frames = Frames.concatenate(list(log))
            with can.LogReader(path) as reader:
                messages = [m for m in reader if not m.is_error_frame and not m.is_remote_frame]
        expected = Frames.from_messages(messages)
        for field in ("t", "ident", "length", "data"):
            assert np.array_equal(getattr(frames, field), getattr(expected, field)), field
        assert log.skipped["remote frame"] > 0
