"""Tables that other programs write: FIT and TCX of bicycle computers, signals in MF4, and what is too much."""

import gzip
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_rides import Rows, fit, tcx, written

from estimator import read
from estimator.can_io.logs import table_parquet
from estimator.can_io.logs.table import SAME_TIME, TableLog
from estimator.commands.main import main
from estimator.errors import RoadloadError
from estimator.samples import Rows as DriveRows
from estimator.settings import Table
from estimator.signals import Role

FIT = {"speed": "enhanced_speed [m/s]", "power": "power [W]", "altitude": "enhanced_altitude [m]"}
TCX = {"speed": "Speed [m/s]", "power": "Watts [W]", "altitude": "AltitudeMeters [m]"}


def ride(seconds: int = 200) -> Rows:
    """A ride that speeds up and climbs steadily."""
    return [(float(t), 5.0 + 0.01 * t, 200.0 + t, 100.0 + 0.2 * t) for t in range(seconds)]


def rows_of(path: Path, columns: dict[str, str]) -> DriveRows:
    (rows,) = read(path, columns=columns).pieces
    return rows


@pytest.mark.parametrize("kind", ["ride.fit", "ride.fit.gz", "ride.tcx", "ride.tcx.gz"])
def test_rides_of_bicycle_computers_are_read(kind: str, tmp_path: Path) -> None:
    content = fit(ride()) if ".fit" in kind else tcx(ride()).encode()
    file = written(gzip.compress(content) if kind.endswith(".gz") else content, tmp_path / kind)
    rows = rows_of(file, FIT if ".fit" in kind else TCX)
    t = rows.t - np.floor(rows.t[0])
    middle = (t > 20) & (t < 180)
    np.testing.assert_allclose(rows.speed[middle], 5.0 + 0.01 * t[middle], atol=2e-3)
    np.testing.assert_allclose(rows.power[middle], 200.0 + t[middle], atol=0.6)
    np.testing.assert_allclose(rows.context[Role.ALTITUDE][middle], 100.0 + 0.2 * t[middle], atol=0.15)


def test_signals_of_an_mf4_file_are_read(tmp_path: Path) -> None:
    """Two groups with times of their own, as a measurement program writes them, in more than one piece of rows."""
    asammdf = pytest.importorskip("asammdf")
    fast, slow = np.arange(0.0, 1600.0, 0.1), np.arange(0.05, 1600.0, 0.5)
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(10.0 + 0.1 * fast, fast, name="v", unit="m/s")])
        file.append([asammdf.Signal(1e4 + 100.0 * slow, slow, name="P", unit="W")])
        file.save(tmp_path / "drive.mf4")
    rows = rows_of(tmp_path / "drive.mf4", {"speed": "v [m/s]", "power": "P [W]"})
    np.testing.assert_allclose(rows.speed[100:400], 10.0 + 0.1 * rows.t[100:400], atol=0.01)
    np.testing.assert_allclose(rows.power[100:400], 1e4 + 100.0 * rows.t[100:400], rtol=1e-3)
    assert len(rows) > 15_000
    with pytest.raises(RoadloadError, match="has no column 'w'; there are "):
        rows_of(tmp_path / "drive.mf4", {"speed": "w [m/s]", "power": "P [W]"})


def test_a_row_between_two_laps_that_repeats_its_time_is_left_out_and_counted(tmp_path: Path) -> None:
    points = list(ride())
    points.insert(100, points[99])
    file = written(tcx(points), tmp_path / "laps.tcx")
    log = TableLog(file, Table(columns=TCX))
    assert sum(len(frames) for frames in log) == 3 * 200
    assert log.skipped == {SAME_TIME: 1}


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cut.fit", fit(ride())[:1500], "is a damaged or cut FIT file ("),
        ("none.fit", b"hello, this is no FIT file at all", "is a damaged or cut FIT file ("),
        ("changed.fit", fit(ride())[:900] + b"!" + fit(ride())[901:], "is a damaged or cut FIT file ("),
        ("cut.tcx", tcx(ride())[:3000], "is no whole XML ("),
        ("bomb.tcx", tcx(ride()).replace("<Training", f"{BOMB}<Training", 1), "declares a document type"),
        ("long.tcx", tcx(ride()).replace("<Time>", f"<Time>{'1' * 5000}", 1), "has a value of over 4096 characters"),
        ("other.mf4", b"MDF     4.10" + bytes(200), "cannot be read as MF4 ("),
        ("line.csv", b"t,v,P\n" + b"1," * 70_000, "has a line of over 65536 characters"),
    ],
)
def test_damaged_files_are_refused_in_one_line(
    name: str, content: bytes | str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = FIT if "fit" in name else TCX if "tcx" in name else {"speed": "v [m/s]", "power": "P [W]"}
    maps = [part for role, column in columns.items() for part in ("--map", f"{role}={column}")]
    for command in ("estimate", "inspect", "diagnose"):
        assert main([command, str(written(content, tmp_path / name)), *maps]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {tmp_path / name}: {said}")


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.data())
def test_spoilt_rides_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    files = [("a.fit", fit(ride(30)), FIT), ("a.tcx", tcx(ride(30)).encode(), TCX)]
    name, whole, columns = data.draw(st.sampled_from(files))
    spoilt = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    spoilt = spoilt[: data.draw(st.integers(0, len(spoilt)))]
    file = written(bytes(spoilt), tmp_path_factory.mktemp("spoilt") / name)
    reason = ""
    try:
        made = read(file, columns=columns)
    except RoadloadError as error:
        reason = str(error)
    assert "\n" not in reason
    assert reason or made.pieces


def test_a_parquet_file_that_unpacks_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page is unpacked as a whole."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(table_parquet, "MAX_CHUNK", 8 << 20)
    table = pa.table({"t": np.arange(9.0), "v": pa.array(["7" * (1 << 20)] * 9), "P": np.zeros(9)})
    pq.write_table(table, tmp_path / "bomb.parquet", compression="zstd", use_dictionary=False)
    assert (tmp_path / "bomb.parquet").stat().st_size < 1 << 17
    with pytest.raises(RoadloadError, match=r"column 'v' unpacks to 9 MiB in one row group; write it in row groups of"):
        rows_of(tmp_path / "bomb.parquet", {"speed": "v [m/s]", "power": "P [W]"})


@pytest.mark.slow
def test_a_long_table_is_read_in_constant_memory(tmp_path: Path) -> None:
    """400,000 rows take no more than 100,000."""
    peaks = []
    for count in (100_000, 400_000):
        t = np.arange(count) / 10
        np.savetxt(tmp_path / "long.csv", np.column_stack([t, t % 30, t % 7]), "%.1f", ",", header="t,v,P", comments="")
        log = TableLog(tmp_path / "long.csv", Table(columns={"speed": "v [m/s]", "power": "P [W]"}))
        tracemalloc.start()
        assert sum(len(frames) for frames in log) == 2 * count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
