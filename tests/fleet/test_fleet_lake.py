"""Decoded signals in a lake of Parquet files: read as the log that they were decoded from."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cantools.database.can import Message

from estimator import config as configuration
from estimator import estimate_drives, estimate_logs
from estimator.can_io.binding import load_database
from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import lake as lakes
from estimator.config import Config
from estimator.errors import ConfigError, DatabaseError, LogError
from estimator.fleet.sources import find_logs, local_copy
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck
from estimator.streaming.log_frames import LogFrames

pa = pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
parquet = pytest.importorskip("pyarrow.parquet")
TRUCK = Truck(mass=20_000.0, A=1300.0, C=3.7)
DAY = 86_400.0  # s
START = 19_737 * DAY + 9 * 3600  # s, 15 January 2024, 9:00 UTC
LAKE = configuration.from_dict({"lake": {}})  # units of the shipped DBC
OWN = {"speed": "Motion.Speed", "engine_power": "Motion.Power"}  # names that no DBC here has
UNITS = {"units": {"Motion.Speed": "km/h", "Motion.Power": "kW"}}
OWN_LAKE = configuration.from_dict({"signals": OWN, "lake": UNITS})


def write(path: Path, columns: dict[str, Any], t: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    times = pa.array(np.round(t * 1e6).astype(np.int64)).cast(pa.timestamp("us"))
    parquet.write_table(pa.table({"t": times, **columns}), path)


def decoded(message: Message, payloads: list[bytes]) -> dict[str, list[float | None]]:
    """The signals of a message as a decoder writes them: numbers, with what is out of range as it is."""
    rows = [message.decode(data, decode_choices=False, scaling=True) for data in payloads]
    return {name: [row[name] for row in rows] for name in rows[0]}


def to_lake(frames: Frames, folder: Path, day: str = "2024/01/15") -> None:
    """Write frames as the decoders of CANedge do: a file a message and sender."""
    messages = {m.frame_id >> 8 & 0x3FFFF: m for m in load_database([]).messages if m.length <= 8}
    for ident in np.unique(frames.ident).tolist():
        message = messages.get(ident >> 8 & 0x3FFFF)
        if message is None:
            continue
        rows = frames[frames.ident == ident]
        columns = decoded(message, [bytes(data) for data in rows.data])
        write(folder / f"CAN1_{message.name}_S{ident & 0xFF:02X}" / day / "00000003_00000001.parquet", columns, rows.t)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same drive as a lake and as a log."""
    folder = tmp_path_factory.mktemp("drive")
    frames = frames_of(simulate(TRUCK, "highway", 360.0, np.random.default_rng(3)).signals)
    t = np.round((frames.t - frames.t[0] + START) * 1e6) / 1e6
    frames = Frames(t, frames.ident, frames.length, frames.data)
    write_log(frames, folder / "2F6913DB.blf")
    to_lake(frames, folder / "lake/2F6913DB")
    return folder


@pytest.mark.slow
def test_a_lake_gives_the_estimate_of_its_log(drive: Path) -> None:
    reference = configuration.from_dict({"vehicle": {"reference_torque_Nm": 2500.0}})
    once = configuration.from_dict({"vehicle": {"reference_torque_Nm": 2500.0}, "gate": {"interval_s": 1e9}})
    log = estimate_logs([drive / "2F6913DB.blf"], once).final  # as a fleet does: at the end of each load
    found = estimate_drives([drive / "lake"], configuration.replace(reference, lake=LAKE.lake))
    assert found["vehicle"].tolist() == ["2F6913DB"]
    assert found["status"].tolist() == ["estimated"]
    assert log.mass is not None
    assert found["mass_kg_mean"][0] == pytest.approx(log.mass.mean, rel=1e-4)
    assert found["mass_kg_mean"][0] == pytest.approx(TRUCK.mass, rel=0.03)
    assert found["mass_kg_sd"][0] == pytest.approx(log.mass.sd, rel=1e-2)
    assert found["source"][0] == f"{drive}/lake/2F6913DB/*/2024/01/15/*.parquet"


@pytest.mark.slow
def test_a_drive_over_midnight_is_one(drive: Path, tmp_path: Path) -> None:
    midnight = START + 180.0
    for file in (drive / "lake").rglob("*.parquet"):
        table = parquet.read_table(file)
        t = table["t"].cast(pa.int64()).to_numpy() / 1e6
        for day, rows in (("2024/01/15", t < midnight), ("2024/01/16", t >= midnight)):
            part = table.filter(pa.array(rows))
            target = tmp_path / "lake/2F6913DB" / file.parents[3].name / day / file.name
            target.parent.mkdir(parents=True)
            parquet.write_table(part, target)
    config = configuration.from_dict({"lake": {}, "vehicle": {"reference_torque_Nm": 2500.0}})
    found = estimate_drives([tmp_path / "lake"], config)
    assert found["files"].tolist() == [2]
    assert found["status"].tolist() == ["estimated"]


def motion(folder: Path, name: str = "CAN1_Motion", n: int = 50, first: float = START, **columns: Any) -> Path:
    """A file of a lake whose names no DBC has."""
    given = {"Speed": np.linspace(0, 72, n), "Power": np.full(n, 10.0), **columns}
    path = folder / "dev" / name / "2024/01/15/1.parquet"
    write(path, given, first + np.arange(n) / 10)
    return path


def day(folder: Path) -> Path:
    return folder / "dev/*/2024/01/15/*.parquet"


def frames(folder: Path, config: Config = OWN_LAKE) -> Frames:
    return Frames.concatenate(list(LogFrames([day(folder)], config)))


def values(found: Frames) -> np.ndarray:
    return found.data.view("<f8")


def test_names_and_units_of_the_configuration_need_no_dbc(tmp_path: Path) -> None:
    motion(tmp_path)
    found = frames(tmp_path)
    assert found.t.tolist() == pytest.approx((START + np.arange(50) / 10).tolist(), abs=1e-6)
    assert values(found)[:, 0].tolist() == np.linspace(0, 72, 50).tolist()
    (message,) = bound_messages(OWN_LAKE)
    assert [bound.conversion.scale for bound in message.signals] == [pytest.approx(1 / 3.6), 1000.0]
    assert not message.j1939


def test_a_signal_without_a_unit_is_named() -> None:
    config = configuration.from_dict({"signals": OWN, "lake": {"units": {"Motion.Speed": "km/h"}}})
    with pytest.raises(DatabaseError, match=r"Motion\.Power has no unit"):
        bound_messages(config)
    with pytest.raises(ConfigError, match=r"lake\.units\.Motion\.Sped: no signal of that name is bound"):
        configuration.from_dict({"signals": OWN, "lake": {"units": {"Motion.Sped": "km/h"}}})
    with pytest.raises(ConfigError, match=r"lake\.ranges\.Motion\.Speed: Expected"):
        configuration.from_dict({"signals": OWN, "lake": {"ranges": {"Motion.Speed": 3}}})


def test_pieces_of_files_come_in_order_of_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    signals = {"speed": "Motion.Speed", "engine_power": "Engine.Power"}
    config = configuration.from_dict(
        {"signals": signals, "lake": {"units": {"Motion.Speed": "m/s", "Engine.Power": "W"}}}
    )
    motion(tmp_path, n=300)
    motion(tmp_path, "CAN1_Engine", n=7, first=START + 11.03)
    whole = frames(tmp_path, config)
    assert (np.diff(whole.t) >= 0).all()
    assert len(whole) == 307
    monkeypatch.setattr(lakes, "ROWS", 4)
    pieces = frames(tmp_path, config)
    for name in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(whole, name), getattr(pieces, name))


def test_a_file_with_large_groups_of_rows_is_read_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    motion(tmp_path, n=10_000, Power=[None, *[10.0] * 9_999])
    whole = frames(tmp_path)
    monkeypatch.setattr(lakes, "LARGE", 0)
    unpacked = frames(tmp_path)
    for name in ("t", "ident", "length", "data"):
        assert np.array_equal(getattr(whole, name), getattr(unpacked, name))


def test_a_full_disk_for_temporary_files_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = motion(tmp_path)

    def full() -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(lakes, "LARGE", 0)
    monkeypatch.setattr(lakes, "TemporaryFile", full)
    with pytest.raises(LogError, match=rf"{path}: cannot be unpacked to .* \(No space left on device\); free space"):
        frames(tmp_path)


@pytest.mark.parametrize("kind", [pa.int64(), pa.float32(), pa.bool_()])
def test_no_value_is_nan_in_every_type_of_column(tmp_path: Path, kind: Any) -> None:
    motion(tmp_path, n=3, Speed=pa.array([1, None, 0]).cast(kind))
    assert values(frames(tmp_path))[:, 0].tolist() == pytest.approx([1.0, np.nan, 0.0], nan_ok=True)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_times_of_every_unit_are_seconds(tmp_path: Path, unit: str) -> None:
    path = motion(tmp_path, n=2)
    times = pa.array([START, START + 1], pa.timestamp("s", tz="UTC")).cast(pa.timestamp(unit, tz="UTC"))
    parquet.write_table(pa.table({"t": times, "Speed": [1.0, 2.0]}), path)
    assert frames(tmp_path).t.tolist() == [START, START + 1]


def test_the_name_of_a_folder_holds_bus_sender_and_more(tmp_path: Path) -> None:
    motion(tmp_path, "CAN1_Motion_S0B_DFF", n=3)
    motion(tmp_path, "CAN1_Motion_Mode_M01_S03", n=2)
    motion(tmp_path, "CAN1_Motion_Summary", n=2)
    assert sorted((frames(tmp_path).ident & 0xFF).tolist()) == [3, 3, 11, 11, 11]


def test_a_message_on_two_buses_asks_for_the_channel(tmp_path: Path) -> None:
    motion(tmp_path, "CAN1_Motion", n=3)
    motion(tmp_path, "CAN2_Motion", n=4)
    with pytest.raises(LogError, match="channels CAN1 and CAN2 both send"):
        frames(tmp_path)
    chosen = configuration.from_dict({"signals": OWN, "lake": UNITS, "bus": {"channels": ["CAN2"]}})
    assert len(frames(tmp_path, chosen)) == 4


def test_what_is_wrong_with_a_lake_is_one_line(tmp_path: Path) -> None:
    path = motion(tmp_path)
    with pytest.raises(LogError, match=r"give a configuration with a table \[lake\]"):
        frames(tmp_path, Config())
    with pytest.raises(LogError, match="no message that a role is bound to"):
        frames(tmp_path, LAKE)
    with pytest.raises(LogError, match=r"take the table \[lake\] out"):
        LogFrames([path], OWN_LAKE)
    with pytest.raises(LogError, match="no such files"):
        LogFrames([day(tmp_path / "nowhere")], OWN_LAKE)
    parquet.write_table(pa.table({"t": [1.0], "Speed": ["fast"]}), path)
    with pytest.raises(LogError, match="column Speed holds no numbers but string"):
        frames(tmp_path)
    parquet.write_table(pa.table({"Speed": [1.0]}), path)
    with pytest.raises(LogError, match="no column of times"):
        frames(tmp_path)
    parquet.write_table(pa.table({"t": pa.array([None], pa.timestamp("us")), "Speed": [1.0]}), path)
    with pytest.raises(LogError, match="1 rows without a time"):
        frames(tmp_path)
    path.write_bytes(motion(tmp_path / "other").read_bytes()[:-20])
    with pytest.raises(LogError, match="cannot be read as Parquet") as caught:
        frames(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_missing_column_and_what_lies_outside_its_range_are_no_values(tmp_path: Path) -> None:
    ranges = {**UNITS, "ranges": {"Motion.Speed": [0, 250]}}
    config = configuration.from_dict({"signals": OWN, "lake": ranges})
    path = motion(tmp_path, n=3, Speed=[10.0, 255.996, 20.0])
    assert values(frames(tmp_path, config))[:, 0].tolist() == [10.0, 255.996, 20.0]
    (message,) = bound_messages(config)
    assert (message.signals[0].signal.minimum, message.signals[0].signal.maximum) == (0, 250)
    write(path, {"Speed": [1.0, 2.0]}, START + np.arange(2.0))
    assert np.isnan(values(frames(tmp_path, config))[:, 1]).all()


def test_days_are_found_in_folders_lists_and_buckets(tmp_path: Path) -> None:
    path = motion(tmp_path / "lake")
    motion(tmp_path / "lake", "LIN1_Other")
    (tmp_path / "lake/dev/drives.parquet").write_bytes(b"")
    summary = tmp_path / "lake/aggregations/tripsummary/2024/01/15/20240115.parquet"
    summary.parent.mkdir(parents=True)
    summary.write_bytes(path.read_bytes())
    name = str(day(tmp_path / "lake"))
    listed = tmp_path / "fleet.txt"
    listed.write_text("lake/dev/*/2024/01/15/*.parquet\tred\n")
    for source, vehicle in ((tmp_path / "lake", "dev"), (tmp_path / "lake/dev", "dev"), (name, "dev"), (listed, "red")):
        (log,) = find_logs([str(source)]).logs
        assert (log.source, log.vehicle) == (name, vehicle)
    fsspec = pytest.importorskip("fsspec")
    files = fsspec.filesystem("memory")
    files.pipe_file("/lake/dev/CAN1_Motion/2024/01/15/1.parquet", path.read_bytes())
    try:
        (log,) = find_logs(["memory://lake"]).logs
        assert (log.source, log.vehicle) == ("memory:///lake/dev/*/2024/01/15/*.parquet", "dev")
        with local_copy(log.source) as copy:
            assert len(Frames.concatenate(list(LogFrames([copy], OWN_LAKE)))) == 50
    finally:
        files.rm("/lake", recursive=True)
