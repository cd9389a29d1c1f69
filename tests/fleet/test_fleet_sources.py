"""Logs of a fleet: where they are found, whose they are, which belong together, and what is wrong with them."""

import errno
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from estimator.can_io.logs import open_log
from estimator.config import Config
from estimator.errors import ConfigError, InputError, LogError
from estimator.fleet.grouping import YEAR, Drive, by_engine, group
from estimator.fleet.sources import LogFile, find_logs, local_copy
from estimator.fleet.survey import Survey, survey
from estimator.streaming.log_frames import FRAMES, TABLES, Kind

T0 = 1_700_000_000.0


def candump(path: Path, start: float = T0, seconds: int = 3) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"({start + i:.6f}) can0 18FEF100#0011223344556677\n" for i in range(seconds + 1)))
    return path


def found(*sources: object, pattern: str | None = None) -> dict[str, str]:
    return {Path(log.source).name: log.vehicle for log in find_logs([str(s) for s in sources], pattern).logs}


def test_a_vehicle_is_the_first_folder_below_the_source(tmp_path: Path) -> None:
    candump(tmp_path / "truck-1/2024/a.log")
    candump(tmp_path / "truck-2/b.log")
    (tmp_path / "truck-2/notes.md").write_text("no log")
    assert found(tmp_path) == {"a.log": "truck-1", "b.log": "truck-2"}
    assert found(tmp_path / "truck-1", tmp_path / "truck-2") == {"a.log": "2024", "b.log": "truck-2"}
    assert found(f"{tmp_path}/truck-*/*.log") == {"b.log": "truck-2"}
    assert found(f"{tmp_path}/**/*.log") == {"a.log": "2024", "b.log": "truck-2"}


def test_device_session_and_split_files_of_a_logger_are_drives_of_the_device(tmp_path: Path) -> None:
    """The card of a CANedge: LOG/DEVICE/SESSION/SPLIT, and a bucket: DEVICE/SESSION/SPLIT-TIME."""
    for later, device in enumerate(("2F6913DB", "AABBCCDD")):
        for session in range(2):
            for split in range(3):
                start = T0 + 86_400.0 * session + 61.0 * split + later
                candump(tmp_path / f"LOG/{device}/{session + 1:08}/{split + 1:08}.log", start, 60)
    logs = find_logs([str(tmp_path / "LOG")]).logs
    drives = group([survey(log, Config()) for log in logs]).drives
    assert [(drive.vehicle, len(drive.sources)) for drive in drives] == [
        ("2F6913DB", 3), ("2F6913DB", 3), ("AABBCCDD", 3), ("AABBCCDD", 3)
    ]  # fmt: skip
    assert [Path(source).name for source in drives[0].sources] == ["00000001.log", "00000002.log", "00000003.log"]


def test_a_vehicle_is_the_engine_that_claims_its_address(tmp_path: Path) -> None:
    first, second = "0102030405060708", "1102030405060708"
    for name, engine, start in (("a", first, 0.0), ("b", "", 62.0), ("c", second, 600.0), ("d", "", 4000.0)):
        path = candump(tmp_path / f"mixed/{name}.log", T0 + start, 60)
        if engine:
            other = f"({T0 + start:.6f}) can0 18EEFF0B#FFFFFFFFFFFFFFFF\n"  # of the brakes
            path.write_text(f"{other}({T0 + start:.6f}) can0 18EEFF00#{engine}\n" + path.read_text())
    surveys = [survey(log, Config()) for log in find_logs([str(tmp_path / "mixed")]).logs]
    assert [one.engine for one in surveys] == ["0807060504030201", "", "0807060504030211", ""]
    drives = group(by_engine(surveys)).drives
    assert [(drive.vehicle, [Path(source).name for source in drive.sources]) for drive in drives] == [
        ("0807060504030201", ["a.log", "b.log"]),
        ("0807060504030211", ["c.log"]),
        ("mixed", ["d.log"]),
    ]


def test_a_name_without_a_serial_number_tells_no_vehicle(tmp_path: Path) -> None:
    path = candump(tmp_path / "mixed/a.log")
    forged, own = "0000000000000000", "0102030405060708"
    path.write_text(f"({T0:.6f}) can0 18EEFF00#{forged}\n" + path.read_text())
    assert survey(LogFile(str(path), "mixed"), Config()).engine == ""
    path.write_text(path.read_text() + f"({T0 + 4:.6f}) can0 18EEFF00#{own}\n")
    assert survey(LogFile(str(path), "mixed"), Config()).engine == "0807060504030201"


def test_a_vehicle_is_the_group_of_a_pattern(tmp_path: Path) -> None:
    candump(tmp_path / "drives/truck-1_monday.log")
    candump(tmp_path / "drives/truck-2_monday.log")
    names = {"truck-1_monday.log": "1", "truck-2_monday.log": "2"}
    assert found(tmp_path, pattern=r"truck-(\d+)_") == names
    with pytest.raises(ConfigError, match="finds no vehicle in this path"):
        found(tmp_path, pattern="bus-(.)")
    with pytest.raises(ConfigError, match="in parentheses"):
        found(tmp_path, pattern="truck")
    with pytest.raises(ConfigError, match="no regular expression"):
        found(tmp_path, pattern="(")


def test_a_list_names_logs_and_vehicles(tmp_path: Path) -> None:
    candump(tmp_path / "a.log")
    candump(tmp_path / "b.log")
    listed = tmp_path / "fleet.txt"
    listed.write_text("a.log\tred\n\nb.log\tblue\n")
    assert found(listed) == {"a.log": "red", "b.log": "blue"}
    listed.write_text("a.log\nc.log\n")
    with pytest.raises(InputError, match=r"fleet\.txt:2: no such log"):
        found(listed)


def test_a_source_without_logs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no logs there"):
        found(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        found(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no logs there"):
        found(f"{tmp_path}/*.blf")


def refuse_to_list(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """As for a user without permissions; the tests may run as root, who has all."""
    listed = Path.iterdir

    def iterdir(self: Path) -> Iterator[Path]:
        if self == folder:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))
        yield from listed(self)

    monkeypatch.setattr(Path, "iterdir", iterdir)


def test_a_folder_that_must_not_be_read_is_an_unreadable_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    candump(tmp_path / "truck-1/a.log")
    candump(tmp_path / "truck-2/b.log")
    locked = tmp_path / "truck-2"
    refuse_to_list(monkeypatch, locked)
    logs = find_logs([str(tmp_path)]).logs
    assert [(log.source, log.vehicle) for log in logs] == [
        (f"{tmp_path}/truck-1/a.log", "truck-1"),
        (str(locked), "truck-2"),
    ]
    surveys = [survey(log, Config()) for log in logs]
    assert [one.fault for one in surveys] == [
        "",
        f"{locked}: cannot be read (Permission denied); check its permissions",
    ]


def test_a_source_that_must_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "locked/a.log"

    def is_dir(self: Path) -> bool:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "is_dir", is_dir)
    with pytest.raises(InputError, match=rf"{source}: cannot be read \(Permission denied\); check its permissions"):
        find_logs([str(source)])
    with pytest.raises(LogError, match=rf"{source}: cannot be read \(Permission denied\); check its permissions"):
        open_log(source)


def test_links_to_folders_are_followed_and_circles_end(tmp_path: Path) -> None:
    candump(tmp_path / "disk/2024/a.log")
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet/truck-1").symlink_to(tmp_path / "disk")
    (tmp_path / "disk/all").symlink_to(tmp_path / "fleet")
    assert [(log.source, log.vehicle) for log in find_logs([str(tmp_path / "fleet")]).logs] == [
        (f"{tmp_path}/fleet/truck-1/2024/a.log", "truck-1")
    ]


@pytest.mark.parametrize(
    ("kind", "logs", "left_out", "remedy"),
    [
        (FRAMES, ["a.log", "b.csv"], ["c.parquet", "d.FIT"], "no logs there but tables; read them with --map"),
        (
            TABLES,
            ["b.csv", "c.parquet", "d.FIT"],
            ["a.log"],
            "no logs there but logs of frames; read them without --map",
        ),
    ],
    ids=["frames", "tables"],
)
def test_files_of_the_other_kind_are_left_out_by_name(
    tmp_path: Path, kind: Kind, logs: list[str], left_out: list[str], remedy: str
) -> None:
    folder = tmp_path / "van"
    folder.mkdir()
    for name in ("a.log", "b.csv", "c.parquet", "d.FIT", ".e.parquet", "notes.md", "photo.jpg"):
        (folder / name).write_text("anything")
    for source in (str(tmp_path), f"{folder}/*"):
        found = find_logs([source], kind=kind)
        assert [Path(log.source).name for log in found.logs] == logs
        assert [Path(name).name for name in found.left_out] == left_out
    others = [str(folder / name) for name in left_out]
    named = find_logs([str(tmp_path), *others], kind=kind)  # are logs with a fault, as any file that is named
    assert (len(named.logs), named.left_out) == (4, [])
    with pytest.raises(InputError, match=remedy):
        find_logs([f"{folder}/*{Path(left_out[0]).suffix}"], kind=kind)


def test_a_log_that_two_sources_name_counts_once(tmp_path: Path) -> None:
    candump(tmp_path / "t/a.log")
    assert len(find_logs([str(tmp_path), str(tmp_path), f"{tmp_path}/t/*.log"]).logs) == 1


def test_logs_of_a_url(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    files = fsspec.filesystem("memory")
    text = candump(tmp_path / "a.log").read_bytes()
    for name in ("/lake/truck-1/a.log", "/lake/truck-2/b.log", "/lake/truck-2/readme.md"):
        files.pipe_file(name, text)
    try:
        logs = find_logs(["memory://lake"]).logs
        assert [(log.source, log.vehicle) for log in logs] == [
            ("memory:///lake/truck-1/a.log", "truck-1"),
            ("memory:///lake/truck-2/b.log", "truck-2"),
        ]
        assert find_logs(["memory://lake/*/a.log"]).logs == logs[:1]
        one = survey(logs[0], Config())
        assert (one.start, one.end, one.fault) == (T0, T0 + 3, "")
        with local_copy(logs[1].source) as path:
            assert path.read_bytes() == text
        assert not path.exists()
        files.pipe_file("/lake/truck-2/empty.log", b"")
        fault = survey(LogFile("memory:///lake/truck-2/empty.log", "truck-2"), Config()).fault
        assert fault.startswith("memory:///lake/truck-2/empty.log: is empty")  # and does not name the copy
        with pytest.raises(LogError, match="cannot be fetched"), local_copy("memory:///lake/gone.log"):
            pass
        with pytest.raises(InputError, match="no logs there"):
            find_logs(["memory://empty"])
    finally:
        files.rm("/lake", recursive=True)


def test_an_unknown_protocol_is_refused() -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(InputError, match="floppy://"):
        find_logs(["floppy://disk/*.log"])


def surveyed(vehicle: str, name: str, start: float, end: float, content: str = "") -> Survey:
    return Survey(log=LogFile(name, vehicle), content=content or name, start=start, end=end)


def sources(drives: tuple[Drive, ...]) -> list[tuple[str, ...]]:
    return [drive.sources for drive in drives]


def test_files_that_continue_each_other_are_one_drive() -> None:
    surveys = [
        surveyed("t", "3", T0 + 120.1, T0 + 180),
        surveyed("t", "1", T0, T0 + 60),
        surveyed("t", "2", T0 + 60.05, T0 + 120),
        surveyed("t", "4", T0 + 200, T0 + 260),
        surveyed("u", "5", T0 + 60.1, T0 + 90),
    ]
    assert sources(group(surveys).drives) == [("1", "2", "3"), ("4",), ("5",)]


def test_files_whose_clock_counts_from_zero_are_not_joined() -> None:
    grouped = group([surveyed("t", "1", 0.0, 60.0), surveyed("t", "2", 60.0, 120.0)])
    assert sources(grouped.drives) == [("1",), ("2",)]
    assert grouped.overlapping("t") == 0
    assert "the clock was not set" in grouped.notes["1"]


@pytest.mark.parametrize(
    ("start", "is_set"),
    [
        (datetime(1980, 1, 6), False),
        (datetime(2000, 1, 1), False),
        (datetime(2010, 1, 1, 8), False),
        (datetime(2011, 6, 1), True),
        (datetime(2015, 6, 1), True),
    ],
)
def test_drives_of_years_ago_are_joined_and_clocks_that_start_anew_are_not(start: datetime, is_set: bool) -> None:
    t = start.replace(tzinfo=UTC).timestamp()
    grouped = group([surveyed("t", "1", t, t + 60), surveyed("t", "2", t + 60, t + 120)])
    assert sources(grouped.drives) == ([("1", "2")] if is_set else [("1",), ("2",)])
    assert ("the clock was not set" in " ".join(grouped.notes.values())) != is_set


def test_a_log_that_appears_twice_is_used_once() -> None:
    grouped = group([surveyed("t", "a", T0, T0 + 60, "same"), surveyed("u", "b", T0, T0 + 60, "same")])
    assert sources(grouped.drives) == [("a",)]
    assert [(one.status, one.reason) for one in grouped.rejected] == [
        ("duplicate", "b: is the same log as a; delete one of them")
    ]


def test_drives_that_overlap_and_clocks_that_differ_by_years_are_named() -> None:
    hours = [surveyed("t", str(i), T0 + 3600 * i, T0 + 3600 * i + 1800) for i in range(4)]
    grouped = group([*hours, surveyed("t", "late", T0 + 5 * YEAR, T0 + 5 * YEAR + 60)])
    assert grouped.overlapping("t") == 0
    assert grouped.notes == {"late": "the clock is +5.0 years from that of most drives of t"}
    assert group([*hours, surveyed("t", "other", T0 + 600, T0 + 1200)]).overlapping("t") == 1


def test_drives_within_a_longer_one_overlap_it_all() -> None:
    spans = ((0, 9000), (2000, 3000), (4000, 5000))
    logs = [surveyed("t", f"{a}", T0 + a, T0 + b) for a, b in spans]
    assert group(logs).overlapping("t") == 2


def test_a_log_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    path = tmp_path / "a.blf"
    path.write_bytes(b"LOGG" + bytes(20))
    one = survey(LogFile(str(path), "t"), Config())
    assert one.fault.startswith(f"{path}: ")
    assert [r.status for r in group([one]).rejected] == ["unreadable"]
    assert "no such file" in survey(LogFile(str(tmp_path / "gone.log"), "t"), Config()).fault
