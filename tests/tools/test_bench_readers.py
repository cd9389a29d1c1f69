"""The measurement of readers side by side: each reader that is installed finds every frame of every format."""

from pathlib import Path

import bench_readers
import pytest


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_reader_finds_every_frame() -> None:
    """A reader that finds fewer is refused, so the table stays true."""
    count, rates = bench_readers.measure(minutes=0.2, repeats=1, formats=list(bench_readers.FORMATS))
    assert count > 1000
    assert {"roadload: read", "roadload: decode", "python-can: read", "asammdf: read"} <= set(rates)
    for name, found in rates.items():
        assert set(found) == set(bench_readers.READERS[name][1])


def test_a_reader_that_loses_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="9 frames of 10"):
        bench_readers.rate(lambda path: 9, tmp_path / "drive.blf", 10, 1)
