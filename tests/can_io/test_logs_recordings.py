"""The log readers on real recordings, against python-can where it can read them."""

from pathlib import Path

import can
import numpy as np
import pytest

from estimator.can_io.frames import Frames
from estimator.can_io.logs import open_log

STATIONARY = Path("j1939_trucks/stationary_format_samples")


def find(recordings: Path, name: Path | str) -> Path:
    path = recordings / name
    if not path.exists():
        pytest.skip(f"no {path}")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "bmw_i3/TripA06.blf",
        "bmw_i3/TripB34.blf",
        STATIONARY / "paccar_mx.trc",
        STATIONARY / "css_truck_idle_11111111.MF4",
    ],
)
def test_equals_python_can(recordings: Path, name: Path | str) -> None:
    path = find(recordings, name)
    if path.suffix == ".MF4":
        pytest.importorskip("asammdf")
    frames = Frames.concatenate(list(open_log(path)))
    with can.LogReader(path) as reader:
        want = Frames.from_messages(m for m in reader if not m.is_error_frame and not m.is_remote_frame)
    for field in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(frames, field), getattr(want, field)), field


def test_lines_that_python_can_drops_from_a_trace_are_counted(recordings: Path) -> None:
    log = open_log(find(recordings, STATIONARY / "paccar_mx.trc"))
    assert sum(map(len, log)) == 27738
    assert log.skipped == {"error frame": 250, "error counter line": 129, "status line": 6}


@pytest.mark.parametrize("name", ["normal", "tsc1", "address_claim_attack"])
def test_screen_form(recordings: Path, name: str) -> None:
    path = find(recordings, f"j1939_trucks/kenworth_t270/{name}.log")
    lines = path.read_text().splitlines()
    log = open_log(path)
    frames = Frames.concatenate(list(log))
    assert len(frames) == len(lines)
    assert not log.skipped
    for i in (0, len(lines) // 2, -1):
        time, _, ident, _, *data = lines[i].split()
        assert frames.t[i] == float(time.strip("()"))
        assert frames.ident[i] & 0x1FFFFFFF == int(ident, 16)
        assert bytes(frames.data[i]) == bytes.fromhex("".join(data))
