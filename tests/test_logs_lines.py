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
from estimator.can_io.logs.digits import decimal, hexadecimal, nibbles

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
