"""The BLF reader against python-can's, frame by frame, and against damage."""

import contextlib
import struct
import tempfile
import tracemalloc
import zlib
from pathlib import Path
from unittest import mock

import can
import numpy as np
import pytest
from can import logconvert
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.logs import inflate, open_log
from estimator.errors import LogError

START = (2024, 2, 4, 29, 12, 30, 15, 250)  # SYSTEMTIME of a leap day
CAN, CAN_ERROR, CAN_ERROR_EXT, CAN2, MARKER, FD, FD64 = 1, 2, 73, 86, 96, 100, 101


def obj(kind: int, body: bytes, time: int = 0, version: int = 1, flags: int = 2) -> bytes:
    """An object with its padding; ``time`` in units that ``flags`` tells."""
    tail = b"" if version == 1 else bytes(8)
    head = struct.pack("<LHHQ", flags, 0, 0, time) + tail
    size = 16 + len(head) + len(body)
    return struct.pack("<4sHHLL", b"LOBJ", 16 + len(head), version, size, kind) + head + body + bytes(size % 4)


def classic(ident: int, data: bytes, flags: int = 0, dlc: int | None = None) -> bytes:
    return struct.pack("<HBBL8s", 1, flags, len(data) if dlc is None else dlc, ident, data)


def fd(ident: int, data: bytes) -> bytes:
    return struct.pack("<HBBLLBBB5x64s", 1, 0, can.util.len2dlc(len(data)), ident, 0, 0, 1, len(data), data)


def fd64(ident: int, data: bytes, valid: int | None = None, flags: int = 0x1000, after: bytes = b"") -> bytes:
    end = 72 + len(data) if after else 0
    valid = len(data) if valid is None else valid
    dlc = can.util.len2dlc(valid)
    return struct.pack("<BBBBLLLLLLLHBBL", 1, dlc, valid, 0, ident, 0, flags, 0, 0, 0, 0, 0, 0, end, 0) + data + after


def blf(payload: bytes, container: int = 1 << 17, pack: bool = True, objects: int = 1) -> bytes:
    """A whole file of ``payload`` cut into containers of ``container`` bytes."""
    body = b""
    for at in range(0, len(payload), container):
        piece = payload[at : at + container]
        packed = zlib.compress(piece, 1) if pack else piece
        size = 32 + len(packed)
        body += struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10) + struct.pack("<H6xL4x", 2 * pack, len(piece))
        body += packed + bytes(size % 4)
    size = 144 + len(body)
    head = struct.pack("<4sLBBBBBBBBQQLL8H8H", b"LOGG", 144, *[0] * 8, size, 0, objects, 0, *START, *START)
    return head.ljust(144, b"\0") + body


def assert_as_python_can(path: Path) -> Frames:
    """Both readers give the same, exactly; returns it."""
    log = open_log(path)
    frames = Frames.concatenate(list(log))
    with can.BLFReader(path) as reader:
        messages = list(reader)
    want = Frames.from_messages(m for m in messages if not m.is_error_frame and not m.is_remote_frame)
    for name in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(frames, name), getattr(want, name)), name
    assert log.skipped["remote frame"] == sum(m.is_remote_frame and not m.is_error_frame for m in messages)
    return frames


@st.composite
def stream(draw: st.DrawFn) -> bytes:
    """Objects of all kinds, times rising; the first is a data frame."""
    parts = [obj(CAN, classic(0x98FEF100, b"LOBJLOBJ"))]
    for time in range(1, draw(st.integers(1, 25))):
        ident = draw(st.integers(0, 0x7FF) | st.integers(0x80000000, 0x9FFFFFFF))
        data = draw(st.binary(max_size=8) | st.just(b"LOBJ"))
        long = draw(st.binary(max_size=64))
        body = draw(
            st.sampled_from(
                [
                    (CAN, classic(ident, data)),
                    (CAN2, classic(ident, data.ljust(8, b"x"), dlc=15) + bytes(8)),
                    (CAN, classic(ident, data, flags=0x80)),
                    (FD, fd(ident, long)),
                    (FD64, fd64(ident, long)),
                    (FD64, fd64(ident, long, valid=64)),
                    (FD64, fd64(ident, long, after=b"extended")),
                    (FD64, fd64(ident, b"", flags=0x1010)),
                    (CAN_ERROR_EXT, bytes(32)),
                    (MARKER, b"LOBJ a marker, 1 to 4 bytes" + bytes(len(data) % 4)),
                ]
            )
        )
        # 1 tick of 10 us is 10000 of 1 ns
        coarse = draw(st.booleans())
        parts.append(obj(*body, time if coarse else time * 10_000, draw(st.sampled_from([1, 2])), 1 if coarse else 2))
    return b"".join(parts)


@pytest.mark.slow
@settings(max_examples=120, deadline=None, derandomize=True)
@given(
    payload=stream(),
    container=st.sampled_from([61, 200, 1000, 1 << 17]),
    pack=st.booleans(),
    run=st.sampled_from([1, 2, 64]),
    stretch=st.sampled_from([20, 200, 1 << 17]),
    joined=st.sampled_from([1, 500, 1 << 19]),
)
def test_equals_python_can(payload: bytes, container: int, pack: bool, run: int, stretch: int, joined: int) -> None:
    """Whatever is taken for a run, and however much is looked at and decoded at once."""
    objects = "estimator.can_io.logs.blf_objects"
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch(f"{objects}.MIN_RUN", run),
        mock.patch(f"{objects}.STRETCH", stretch),
        mock.patch("estimator.can_io.logs.blf.JOINED", joined),
    ):
        path = Path(folder) / "a.blf"
        path.write_bytes(blf(payload, container, pack))
        assert_as_python_can(path)


def test_runs_with_other_objects_between(tmp_path: Path) -> None:
    runs = [
        (300, CAN, classic(0x98FEF100, b"12345678")),
        (1, MARKER, b"LOBJ in a marker"),
        (200, FD, fd(0x123, bytes(range(64)))),
        (70, CAN2, classic(0x124, b"1234") + bytes(8)),
        (1, CAN, classic(0x125, b"", flags=0x80)),
        (500, CAN, classic(0x126, b"12")),
        (100, FD64, fd64(0x127, bytes(12))),
    ]
    every = [(kind, body) for count, kind, body in runs for _ in range(count)]
    path = tmp_path / "a.blf"
    path.write_bytes(blf(b"".join(obj(kind, body, i * 1000) for i, (kind, body) in enumerate(every)), 3000))
    assert len(assert_as_python_can(path)) == 1170


def test_a_wrong_frame_in_a_run_is_found(tmp_path: Path) -> None:
    good, wrong = obj(CAN, classic(0x123, b"12345678")), obj(CAN, classic(0x123, b"", dlc=8)[:-8])
    path = tmp_path / "a.blf"
    path.write_bytes(blf(good * 200 + wrong + good))
    with pytest.raises(LogError, match=r"a CAN frame longer than its object\) after 200 frames"):
        list(open_log(path))


def test_without_libdeflate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = written(tmp_path / "a.blf", 3000, 4096)
    want = assert_as_python_can(tmp_path / "a.blf")

    def refuse(data: bytes, originalsize: int) -> bytes:
        raise inflate.DeflateError

    monkeypatch.setattr(inflate, "zlib_decompress", refuse)
    (tmp_path / "b.blf").write_bytes(raw)
    assert np.array_equal(assert_as_python_can(tmp_path / "b.blf").data, want.data)


@pytest.mark.parametrize("said", [0, 1, 30_000, 2**31])
def test_a_container_that_gives_a_wrong_size(tmp_path: Path, said: int) -> None:
    """As python-can, which ignores it."""
    payload = b"".join(obj(CAN, classic(0x123, b"12345678"), i) for i in range(100))
    raw = bytearray(blf(payload))
    struct.pack_into("<L", raw, 144 + 24, said)
    (tmp_path / "a.blf").write_bytes(raw)
    assert len(assert_as_python_can(tmp_path / "a.blf")) == 100


def test_values_and_counts(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    payload = (
        obj(CAN, classic(0x123, b"\x01\x02\x03"), 1_500_000_000)
        + obj(CAN_ERROR, bytes(8), 1_500_000_000)
        + obj(CAN_ERROR_EXT, bytes(32), 1_500_000_000)
        + obj(MARKER, b"note", 1_500_000_000)
        + obj(FD64, fd64(0x98FEF100, b"abcdefghijkl"), 200_000, version=2, flags=1)
    )
    path.write_bytes(blf(payload))
    log = open_log(path)
    (frames,) = log
    start = 1709209815.25  # 2024-02-29 12:30:15.250 UTC
    assert frames.t.tolist() == [start + 1.5, start + 2.0]
    assert frames.ident.tolist() == [0x123, 0x98FEF100]
    assert frames.data.shape == (2, 64)
    assert bytes(frames.data[0]) == b"\x01\x02\x03" + bytes(61)
    assert bytes(frames.data[1, :12]) == b"abcdefghijkl"
    assert log.skipped == {"error frame": 2, "BLF object of type 96": 1}


def written(path: Path, count: int, container: int) -> bytes:
    with can.BLFWriter(path, max_container_size=container) as writer:
        for i in range(count):
            data = i.to_bytes(8, "little")
            writer(can.Message(timestamp=1e9 + 0.01 * i, arbitration_id=0x18FEF100, data=data))
    return path.read_bytes()


def refuse(path: Path) -> tuple[int, str]:
    """Read up to the LogError: the frames before it, and what it says."""
    frames = 0
    try:
        for batch in open_log(path):
            frames += len(batch)
    except LogError as error:
        return frames, str(error)
    pytest.fail("no LogError")


@pytest.mark.slow
def test_cut_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "cut.blf"
    raw = written(path, 60, 700)
    most = 0
    for cut in range(1, len(raw), 3):
        path.write_bytes(raw[:cut])
        frames, text = refuse(path)
        assert text.startswith(f"{path}: ")
        assert "\n" not in text
        assert frames >= most or cut < 144
        most = max(most, frames)
        if cut >= 144:
            assert f"after {frames} frames" in text
            assert f"byte {cut} " in text or "container" in text
    assert most == 60


def test_what_the_message_proposes_saves_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cut.blf"
    path.write_bytes(written(path, 2000, 4096)[:-1000])
    frames, text = refuse(path)
    repaired = tmp_path / "repaired.blf"
    assert f"python -m can.logconvert '{path}' repaired.blf" in text
    monkeypatch.setattr("sys.argv", ["can_logconvert", str(path), str(repaired)])
    logconvert.main()
    assert 0 < frames == sum(map(len, open_log(repaired)))


def test_writer_was_killed(tmp_path: Path) -> None:
    path = tmp_path / "killed.blf"
    writer = can.BLFWriter(path, max_container_size=1000)
    for i in range(100):
        writer(can.Message(timestamp=1e9 + i, arbitration_id=1, data=b"x"))
    writer.file.flush()
    raw = path.read_bytes()
    writer.stop()
    path.write_bytes(raw)
    frames, text = refuse(path)
    assert frames > 80
    assert "never closed" in text
    assert f"after {frames} frames" in text


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (obj(CAN, b"short"), "a CAN frame longer than its object"),
        (obj(FD64, fd64(1, bytes(64), valid=65)), "a CAN frame longer than its object"),
        (b"no object starts here, at all", "no object where one should start"),
        (b"LOBJ" + bytes(28), "an object of 0 bytes"),
        (b"LOBJ" + b"\xff" * 28, "an object of 4294967295 bytes"),
        (obj(CAN, classic(1, b"x"))[:-9], "ends too early"),
    ],
)
def test_damage_inside_a_container(tmp_path: Path, damage: bytes, reason: str) -> None:
    path = tmp_path / "a.blf"
    path.write_bytes(blf(obj(CAN, classic(1, b"x")) * 5 + damage))
    frames, text = refuse(path)
    assert frames == 5
    assert reason in text


def test_bogus_sizes_reserve_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    good = blf(obj(CAN, classic(1, b"x")) * 5)
    cases = [
        good[:152] + b"\xff\xff\xff\xff" + good[156:],  # size of the container
        good[:168] + b"\xff\xff\xff\xff" + good[172:],  # unpacked size: not needed
        good[:4] + b"\xff\xff\xff\x7f" + good[8:],  # size of the file header
        blf(b"LOBJ" + struct.pack("<HHLL", 32, 1, 1 << 24, 1) + bytes(1 << 20), container=1 << 27),
        blf(bytes(1 << 27), container=1 << 27),  # 128 MiB of zeros in 128 kB
    ]
    tracemalloc.start()
    try:
        for raw in cases:
            path.write_bytes(raw)
            with contextlib.suppress(LogError):
                assert sum(map(len, open_log(path))) == 5
        assert tracemalloc.get_traced_memory()[1] < 600e6
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("pack", [True, False])
def test_flipped_bytes_are_read_or_refused(tmp_path: Path, pack: bool) -> None:
    rng = np.random.default_rng(5)
    path = tmp_path / "a.blf"
    parts = [obj(*one, 1000 * i) for i, one in enumerate([(CAN, classic(1, b"x")), (FD, fd(2, b"y" * 64))] * 20)]
    raw = blf(b"".join(parts), 600, pack)
    for _ in range(400):
        mutant = bytearray(raw)
        for _ in range(rng.choice([1, 2, 30])):
            mutant[rng.integers(len(raw))] = rng.integers(256)
        path.write_bytes(mutant)
        try:
            assert sum(map(len, open_log(path)))
        except LogError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_signature_in_the_payload(tmp_path: Path) -> None:
    """A log that spells the signature in its payload takes the slow path and reads the same."""
    path = tmp_path / "a.blf"
    path.write_bytes(blf(b"".join(obj(CAN, classic(1, b"LOBJ" + bytes([i])), i) for i in range(200)), 999))
    assert len(assert_as_python_can(path)) == 200
