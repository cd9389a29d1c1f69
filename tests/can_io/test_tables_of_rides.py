"""Tables that other programs write: FIT and TCX of bicycle computers, signals in MF4, and what is too much."""

import gzip
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_rides import Rows, checksum, fit, tcx, written

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


@pytest.mark.slow
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
    for columns, said in (
        ({"speed": "w [m/s]"}, "has no column 'w'; there are "),
        ({"speed": "v [km/h]"}, r"column 'v' is in 'm/s' by the file, and 'v \[km/h\]' takes it in 'km/h'; write \"v"),
        ({"speed": "v [m/s]", "time": "time [ms]"}, "column 'time' is in 's' by the file"),
    ):
        with pytest.raises(RoadloadError, match=said):
            rows_of(tmp_path / "drive.mf4", {**columns, "power": "P [W]"})


@pytest.mark.slow
def test_times_of_channels_are_no_columns_whatever_they_are_called(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    t = np.arange(300) / 10
    with asammdf.MDF(version="4.10") as file:
        for name in ("v", "P"):
            signal = asammdf.Signal(np.full(300, 50.0), t, name=name, master_metadata=("t", 1))
            file.append([signal])
        file.save(tmp_path / "a.mf4")
    assert rows_of(tmp_path / "a.mf4", {"speed": "v [m/s]", "power": "P [W]"}).speed[50] == 50.0


def test_a_row_between_two_laps_that_repeats_its_time_is_left_out_and_counted(tmp_path: Path) -> None:
    points = list(ride())
    points.insert(100, points[99])
    file = written(tcx(points), tmp_path / "laps.tcx")
    log = TableLog(file, Table(columns=TCX))
    assert sum(len(frames) for frames in log) == 3 * 200
    assert log.skipped == {SAME_TIME: 1}


@pytest.mark.parametrize(("name", "column"), [("a.fit", "enhanced_speed"), ("a.tcx", "Speed")])
def test_another_unit_than_that_of_the_format_is_refused(
    name: str, column: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(fit(ride()) if ".fit" in name else tcx(ride()), tmp_path / name)
    assert main(["inspect", str(file), "--map", f"speed={column} [km/h]", "--map", "power=power [W]"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"error: {file}: column '{column}' is in 'm/s' by the file, and '{column} [km/h]' takes it in 'km/h'; "
        f'write "{column} [m/s]", or correct the unit in the file'
    )


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'

POINT = "<Trackpoint><n{i}>1</n{i}></Trackpoint>"


def forged(fields: bytes, records: bytes) -> bytes:
    """A FIT file whose checksums are right, with one definition, of ``fields``, and records."""
    body = struct.pack("<BBBHB", 0x40, 0, 0, 20, len(fields) // 3) + fields + records
    head = struct.pack("<BBHI4sH", 14, 0x10, 2132, len(body), b".FIT", 0)
    return head + body + struct.pack("<H", checksum(head + body))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cut.fit", fit(ride())[:1500], "is a damaged or cut FIT file ("),
        ("none.fit", b"hello, this is no FIT file at all", "is a damaged or cut FIT file ("),
        ("changed.fit", fit(ride())[:900] + b"!" + fit(ride())[901:], "is a damaged or cut FIT file ("),
        ("size.fit", forged(bytes([253, 0, 0x86, 6, 2, 0x84]), b"\0\1\2" * 9), "is a damaged or cut FIT file (size)"),
        ("kind.fit", forged(bytes([253, 4, 0xFF]), b"\0" * 50), "is a damaged or cut FIT file ("),
        ("back.fit", fit([*ride()[:100], *ride()[50:]]), "row 101: time steps back from "),
        ("cut.tcx", tcx(ride())[:3000], "is no whole XML ("),
        ("bomb.tcx", tcx(ride()).replace("<Training", f"{BOMB}<Training", 1), "declares a document type"),
        ("long.tcx", tcx(ride()).replace("<Time>", f"<Time>{'1' * 5000}", 1), "has a value of over 4096 characters"),
        ("deep.tcx", "<a>" * 5000, "has over 4096 elements in one another"),
        ("tag.tcx", f"<a b='{'x' * (5 << 20)}", "has a tag of over 1 MiB"),
        ("kinds.tcx", f"<a>{''.join(POINT.format(i=i) for i in range(5000))}</a>", "has over 4096 kinds of values"),
        ("encoding.tcx", tcx(ride()).replace("UTF-8", "UTF-7000"), "is no whole XML (unknown encoding"),
        ("twice.csv", "t,v,P,v\n0,1,2,3\n", "has the column 'v' 2 times; rename or leave out one"),
        ("other.mf4", b"MDF     4.10" + bytes(200), "cannot be read as MF4 ("),
        ("line.csv", b"t,v,P\n" + b"1," * 70_000, "has a line of over 65536 characters"),
    ],
)
def test_damaged_files_are_refused_in_one_line(
    name: str, content: bytes | str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = FIT if "fit" in name else TCX if "tcx" in name else {"speed": "v [m/s]", "power": "P [W]"}
    maps = [part for role, column in columns.items() for part in ("--map", f"{role}={column}")]
    assert main(["estimate", str(written(content, tmp_path / name)), *maps]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / name}: {said}")


@pytest.mark.parametrize("command", ["inspect", "diagnose"])
def test_each_command_refuses_a_damaged_file(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, str(written(fit(ride())[:1500], tmp_path / "a.fit")), "--map", f"speed={FIT['speed']}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'a.fit'}: is a damaged or cut FIT file (")


def measurement(path: Path, v: np.ndarray, t: np.ndarray) -> bytearray:
    """An MF4 file of two channels, of which the second is constant."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(v, t, name="v", encoding="utf-8"), asammdf.Signal(np.ones(len(t)), t, name="P")])
        return bytearray(Path(file.save(path / "whole.mf4")).read_bytes())


def without_master(content: bytearray) -> bytearray:
    """The file with the channel of times as a channel like others."""
    block = -1
    while (block := content.find(b"##CN", block + 1)) >= 0:
        (links,) = struct.unpack_from("<Q", content, block + 16)
        content[block + 24 + 8 * links : block + 26 + 8 * links] = bytes(2)  # kind of channel, and of its times
    return content


@pytest.mark.slow
def test_measurements_that_give_no_numbers_in_time_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t, v = np.arange(300) / 10, np.full(300, 50.0)
    for content, said in (
        (without_master(measurement(tmp_path, v, t)), "the channel 'P' has no times; export it with them"),
        (measurement(tmp_path, v, t[::-1]), "the times of the channel 'P' step back, or are no numbers"),
        (measurement(tmp_path, np.full(300, b"fast"), t), "the channel 'v' holds no numbers; choose another one"),
        (measurement(tmp_path, v, t)[:-100], "cannot be read as MF4 ("),
    ):
        (tmp_path / "a.mf4").write_bytes(content)
        assert main(["inspect", str(tmp_path / "a.mf4"), "--map", "speed=v [m/s]", "--map", "power=P [W]"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {tmp_path / 'a.mf4'}: {said}")


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
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


@pytest.mark.nightly
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


def test_columns_that_are_not_asked_for_take_no_memory(tmp_path: Path) -> None:
    """3,000 rows of 1,000 columns, and a blank line at the end."""
    row = ",1,1" + 998 * ",7"
    head = "t,v,P," + ",".join(f"c{i}" for i in range(998))
    (tmp_path / "wide.csv").write_text(head + "".join(f"\n{i / 10}{row}" for i in range(3000)) + "\n\n")
    log = TableLog(tmp_path / "wide.csv", Table(columns={"speed": "v [m/s]", "power": "P [W]"}))
    tracemalloc.start()
    assert sum(len(frames) for frames in log) == 6000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 << 20
