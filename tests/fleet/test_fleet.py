"""A fleet from logs to tables: `roadload fleet` and `estimate_drives`, on simulated trucks."""

import csv
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import replace
from datetime import datetime
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimator import config as configuration
from estimator import estimate_drives
from estimator.answers.diagnosis import Verdict
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.fleet import road_load
from estimator.commands.main import main
from estimator.config import Config
from estimator.diagnosis.result import Diagnosis, Finding, Magnitude
from estimator.errors import ConfigError, RoadloadError
from estimator.fleet import cache, output
from estimator.fleet.cache import Cache
from estimator.fleet.drive_result import DriveResult
from estimator.fleet.engine import Distributed, Engine, Failure, Serial, dask_engine
from estimator.fleet.output import check_names
from estimator.fleet.rows import drive_rows
from estimator.fleet.run import run_fleet
from estimator.fleet.sources import find_logs
from estimator.output_files import whole
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck
from estimator.streaming.row_stream import RowStream

pyarrow = pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
pytestmark = pytest.mark.slow
TRUTH = {"truck-1": Truck(mass=20_000.0, A=1300.0, C=3.7), "truck-2": Truck(mass=18_000.0, A=1170.0, C=5.0)}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trucks: one drive of truck-1 in two files that continue each other, one of truck-2; and what goes wrong."""
    folder = tmp_path_factory.mktemp("fleet")
    for i, (name, truck) in enumerate(TRUTH.items()):
        frames = frames_of(simulate(truck, "highway", 360.0, np.random.default_rng(3)).signals)
        frames = replace(frames, t=frames.t + 86_400.0 * i)
        (folder / name).mkdir()
        half = len(frames) // 2
        parts = {"a.blf": frames[:half], "b.blf": frames[half:]} if i == 0 else {"a.blf": frames}
        for file, part in parts.items():
            write_log(part, folder / name / file)
    shutil.copy(folder / "truck-2/a.blf", folder / "truck-2/copy.blf")
    (folder / "truck-2/cut.blf").write_bytes((folder / "truck-2/a.blf").read_bytes()[:200_000])
    idle = Frames(np.arange(60) + 1.7e9, *(getattr(frames[:60], name) for name in ("ident", "length", "data")))
    write_log(idle, folder / "truck-2/idle.blf")
    return folder


@pytest.fixture(scope="module")
def table(fleet: Path) -> dict[str, Any]:
    """What the library makes of it."""
    return estimate_drives([fleet], Config())


def ask(*arguments: object) -> tuple[int, dict[str, Any], list[str]]:
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main(["fleet", *map(str, arguments), "--json"])
    return status, json.loads(out.getvalue() or "{}"), err.getvalue().splitlines()


def row(table: dict[str, Any], source: str) -> dict[str, Any]:
    (at,) = np.flatnonzero([text.endswith(source) for text in table["source"]])
    return {name: column[at] for name, column in table.items()}


def test_drives_are_estimated_and_split_files_are_one(table: dict[str, Any]) -> None:
    assert sorted(table["status"]) == ["duplicate", "estimated", "estimated", "failed", "unreadable"]
    for name, truck in TRUTH.items():
        found = row(table, f"{name}/a.blf")
        for parameter, truth in (("mass_kg", truck.mass), ("A_N", truck.A), ("C_N_s2_m2", truck.C)):
            assert abs(found[f"{parameter}_mean"] - truth) < 4 * found[f"{parameter}_sd"]
        assert abs(found["joint_mass_kg_mean"] / truck.mass - 1) < 0.03
        assert found["minutes"] == pytest.approx(6, abs=0.1)
    assert row(table, "truck-1/a.blf")["files"] == 2


def test_a_bad_log_is_a_row_with_its_reason(table: dict[str, Any]) -> None:
    assert "damaged or cut" in row(table, "cut.blf")["reason"]
    assert "is the same log as" in row(table, "copy.blf")["reason"]
    assert "too seldom to see how it changes" in row(table, "idle.blf")["reason"]
    assert all("\n" not in reason for reason in table["reason"])


def test_pandas_and_polars_take_the_table(table: dict[str, Any]) -> None:
    pandas, polars = pytest.importorskip("pandas"), pytest.importorskip("polars")
    assert pandas.DataFrame(table)["mass_kg_mean"].notna().sum() == 2
    assert polars.DataFrame(table)["mass_kg_mean"].is_not_nan().sum() == 2


def test_a_vehicle_is_told_with_standard_deviations_in_the_units_of_an_estimate() -> None:
    values = {"A_per_mass_N_kg": (0.07488, 0.0059), "C_N_s2_m2": (2.866, 0.59), "c_rr": (0.00763, 0.0006)}
    found = {f"{name}_mean": mean for name, (mean, _) in values.items()}
    found |= {f"{name}_sd": sd for name, (_, sd) in values.items()} | {"c_d_A_m2_mean": 4.66}
    told = road_load({**found, "A_per_mass_reason": "", "C_reason": ""})
    assert told == "A/m 0.0749 ± 0.0059 N/kg (c_rr 0.763 %), C 2.87 ± 0.59 N s²/m² (c_d A 4.66 m²)"


class Counted(Serial):
    """Counts the drives that are computed."""

    def __init__(self) -> None:
        self.estimated: list[str] = []

    def map(self, work: Any, items: Any) -> Iterator[Any]:
        if getattr(getattr(work, "func", None), "__name__", "") == "estimate_drive":
            self.estimated += [drive.sources[0] for drive in items]
        yield from super().map(work, items)


def test_a_rerun_computes_what_is_new(fleet: Path, tmp_path: Path, table: dict[str, Any]) -> None:
    shutil.copytree(fleet, tmp_path / "in")
    cache = Cache.of(tmp_path / "cache", Config(), with_diagnosis=False)
    engine = Counted()
    first = run_fleet(find_logs([str(tmp_path / "in/truck-1")]).logs, Config(), engine, cache=cache)
    sizes = [path.stat().st_size for path in (tmp_path / "cache").iterdir()]
    assert len(sizes) == 1
    assert max(sizes) < 20_000
    (tmp_path / "in/truck-1").rename(tmp_path / "in/other name")
    again = run_fleet(find_logs([str(tmp_path / "in")]).logs, Config(), engine, cache=cache)
    assert [Path(source).name for source in engine.estimated] == ["a.blf", "idle.blf", "a.blf"]
    assert again.results[0] == first.results[0]
    assert again.results[0].segments[0].parameters["m"].posterior.mean == row(table, "truck-1/a.blf")["mass_kg_mean"]
    other = configuration.from_dict({"gate": {"minimum_samples": 700}})
    key = Cache.of(tmp_path / "cache", other, with_diagnosis=False)
    assert [key.get(drive) for drive in again.grouped.drives] == [None] * 3
    assert [cache.get(drive) is None for drive in again.grouped.drives] == [False, True, False]  # not of a failure
    for path in (tmp_path / "cache").iterdir():
        path.write_text("{")
    assert [cache.get(drive) for drive in again.grouped.drives] == [None] * 3


def test_effects_that_a_diagnosis_names_are_a_table(
    fleet: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import pyarrow.parquet

    found = Finding(
        name="headwind",
        probability=0.98,
        log_bayes_factor=12.5,
        equivalent=(),
        magnitude=Magnitude("wind", 6.1, 0.4, "m/s"),
        gap_closed=None,
        rms_before=9e3,
        rms_after=7e3,
        shift=None,
    )
    diagnosis = Diagnosis(verdict=Verdict.EFFECT, effects=(found,))
    monkeypatch.setattr("estimator.streaming.drive_extraction.diagnose_drive", lambda paths, config: diagnosis)
    logs = find_logs([str(fleet / "truck-2/a.blf")]).logs
    output.prepare(tmp_path)
    result = run_fleet(logs, Config(), Serial(), with_diagnosis=True)
    output.write_fleet(result, Config(), tmp_path, 0.05, with_diagnosis=True)
    (effect,) = pyarrow.parquet.read_table(tmp_path / "effects.parquet").to_pylist()
    assert effect == {
        "source": logs[0].source,
        "vehicle": "truck-2",
        "effect": "headwind",
        "probability": 0.98,
        "log_bayes_factor": 12.5,
        "magnitude": "wind",
        "value": 6.1,
        "sd": 0.4,
        "unit": "m/s",
    }
    assert drive_rows(result)[0]["verdict"] == "effect"


def test_an_error_in_a_task_is_the_reason_of_its_drive(monkeypatch: pytest.MonkeyPatch, fleet: Path) -> None:
    def broken(*_: object, **__: object) -> DriveResult:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("estimator.fleet.run.estimate_drive", broken)
    found = run_fleet(find_logs([str(fleet / "truck-1")]).logs, Config(), Serial())
    assert [(r["status"], r["reason"]) for r in drive_rows(found)] == [("failed", "ZeroDivisionError: by zero")]
    assert found.vehicles[0].status == "unestimated"


def test_only_the_road_likelihood_can_be_joined(fleet: Path) -> None:
    other = configuration.from_dict({"sampler": {"likelihood": "paper"}})
    with pytest.raises(ConfigError, match=r"sampler\.likelihood"):
        estimate_drives([fleet], other)


@pytest.mark.parametrize(
    ("tables", "key"),
    [({"load": {"stop_s": 15}}, r"load\.stop_s: loads between shorter stops"), ({"effects": ["foo"]}, "foo")],
)
def test_what_no_drive_can_be_joined_with_is_refused_before_the_work(
    fleet: Path, tables: dict[str, Any], key: str
) -> None:
    with pytest.raises(ConfigError, match=key):
        estimate_drives([fleet], configuration.from_dict(tables))


def test_a_drive_with_a_contested_input_is_withheld_as_by_estimate(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RowStream, "contested", {"EEC1.EngSpeed": "two senders"})
    found = run_fleet(find_logs([str(fleet / "truck-2/a.blf")]).logs, Config(), Serial())
    (row,) = drive_rows(found)
    assert row["status"] == "unestimated"
    assert "contested" in row["reason"]
    assert not found.results[0].segments[0].mean
    assert found.vehicles[0].status == "unestimated"


def test_vehicles_whose_files_would_have_one_name_are_refused() -> None:
    check_names(["a", "b", "a"])
    for pair in (["a/b", "a:b"], [".x", "x"], ["Red", "red"], ["new-vehicle"], ["n" * 300 + "1", "n" * 300 + "2"]):
        with pytest.raises(ConfigError, match="would have one file"):
            check_names(pair)


def test_results_of_another_program_are_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = Cache.of(tmp_path, Config(), False).settings
    assert Cache.of(tmp_path, Config(), False).settings == before
    (tmp_path / "program").mkdir()
    (tmp_path / "program/module.py").write_text("A = 1\n")
    monkeypatch.setattr(cache, "PROGRAM", tmp_path / "program")
    assert Cache.of(tmp_path, Config(), False).settings != before


@pytest.fixture(scope="module")
def outputs(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, dict[str, Any], list[str]]]:
    """The command in this process and on two workers."""
    pytest.importorskip("distributed")
    made = []
    for is_serial in (True, False):
        out = tmp_path_factory.mktemp("out") / "fleet"
        with pytest.MonkeyPatch.context() as patch:
            if is_serial:
                patch.setattr("estimator.commands.fleet.dask_engine", lambda *_: nullcontext(Serial()))
            status, answer, lines = ask(fleet, "-o", out, "--workers", 2, "--report")
        assert status == 0
        made.append((out, answer, lines))
    return made


def test_one_process_and_two_workers_give_the_same_bits(outputs: list[tuple[Path, dict[str, Any], list[str]]]) -> None:
    (one, first, _), (two, second, _) = outputs
    names = sorted(str(path.relative_to(one)) for path in one.rglob("*") if path.is_file())
    assert names == sorted(str(path.relative_to(two)) for path in two.rglob("*") if path.is_file())
    assert {"priors/truck-1.toml", "fleet.html", "seasons.parquet", "road.parquet"} <= set(names)
    for name in names:
        assert (one / name).read_bytes() == (two / name).read_bytes()
    assert first["rows"] == second["rows"] == {"estimated": 2, "duplicate": 1, "unreadable": 1, "failed": 1}


@pytest.fixture
def cluster() -> Iterator[tuple[str, int]]:
    """A scheduler and a worker of their own: its address, and its process."""
    pytest.importorskip("distributed")
    dask = [sys.executable, "-m", "dask"]
    command = [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    scheduler = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    worker = None
    try:
        assert scheduler.stderr is not None
        address = next(found[1] for line in scheduler.stderr if (found := re.search(r"at: *(tcp://\S+)", line)))
        command = [*dask, "worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        worker = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        yield address, scheduler.pid
    finally:
        for process in (worker, scheduler):
            if process is not None:
                process.kill()
                process.communicate()


def test_a_cluster_gives_the_same_bits(
    fleet: Path, outputs: list[tuple[Path, dict[str, Any], list[str]]], cluster: tuple[str, int], tmp_path: Path
) -> None:
    status, answer, _ = ask(fleet, "-o", tmp_path / "fleet", "--scheduler", cluster[0], "--report")
    assert status == 0
    assert answer["rows"] == outputs[0][1]["rows"]
    for path in outputs[0][0].rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / "fleet" / path.relative_to(outputs[0][0])).read_bytes()


def test_a_scheduler_that_goes_away_is_one_line(cluster: tuple[str, int]) -> None:
    address, process = cluster
    program = (
        "import os, signal, sys\n"
        "from estimator.errors import RoadloadError\n"
        "from estimator.fleet.engine import dask_engine\n"
        "try:\n"
        "    with dask_engine(sys.argv[1], 1) as engine:\n"
        "        list(engine.map(lambda pid: os.kill(pid, signal.SIGTERM), [int(sys.argv[2])]))\n"
        "except RoadloadError as error:\n"
        "    print(error, file=sys.stderr)\n"
    )
    command = [sys.executable, "-c", program, address, str(process)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.stderr == "the scheduler has gone away; run again: the drives that are done are kept\n"


def test_an_interrupt_from_the_terminal_is_no_traceback() -> None:
    pytest.importorskip("distributed")
    program = (
        "import os, signal\n"
        "from estimator.fleet.engine import dask_engine\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it\n"
        "    try:\n"
        "        with dask_engine(None, 2) as engine:\n"
        "            list(engine.map(lambda group: os.killpg(group, signal.SIGINT), [os.getpgid(0)]))\n"
        "            signal.pause()\n"
        "    except KeyboardInterrupt:\n"
        "        print('interrupted')\n"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, start_new_session=True)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


def test_each_fault_is_one_line(outputs: list[tuple[Path, dict[str, Any], list[str]]]) -> None:
    for _, _, lines in outputs:
        assert sorted(line.split(":")[0] for line in lines) == ["duplicate", "failed", "unreadable"]


def test_units_are_in_the_schema(outputs: list[tuple[Path, dict[str, Any], list[str]]]) -> None:
    import pyarrow.parquet

    schema = pyarrow.parquet.read_schema(outputs[0][0] / "drives.parquet")
    units = {name: (schema.field(name).metadata or {}).get(b"unit") for name in schema.names}
    assert units["mass_kg_mean"] == b"kg"
    assert units["A_N_q95"] == b"N"
    assert units["C_N_s2_m2_sd"] == b"N s2/m2"
    assert units["minutes"] == b"min"
    assert units["vehicle"] is None


def test_duckdb_joins_drives_and_vehicles(
    outputs: list[tuple[Path, dict[str, Any], list[str]]], table: dict[str, Any]
) -> None:
    duckdb = pytest.importorskip("duckdb")
    out = outputs[0][0]
    found = duckdb.sql(
        f"select d.vehicle, d.mass_kg_mean, v.C_N_s2_m2_mean from '{out}/drives.parquet' d "
        f"join '{out}/vehicles.parquet' v using (vehicle) where d.status = 'estimated' order by d.vehicle"
    ).fetchall()
    assert [name for name, _, _ in found] == ["truck-1", "truck-2"]
    assert [mass for _, mass, _ in found] == [row(table, f"{name}/a.blf")["mass_kg_mean"] for name in TRUTH]
    assert [C for _, _, C in found] == pytest.approx([truck.C for truck in TRUTH.values()], rel=0.15)


def test_learnt_beliefs_configure_a_gateway(outputs: list[tuple[Path, dict[str, Any], list[str]]]) -> None:
    learnt = configuration.load(outputs[0][0] / "priors/truck-1.toml")
    truck = TRUTH["truck-1"]
    for belief, truth in ((learnt.prior.C_belief_N_s2_m2, truck.C), (learnt.prior.A_belief_N, truck.A)):
        assert belief is not None
        assert abs(belief[0] - truth) < 2 * belief[1]
    plain = learnt.prior.__class__()
    assert configuration.replace(learnt, prior=plain) == Config()


def test_a_full_disk_leaves_the_tables_of_before(fleet: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "out"
    output.prepare(out)
    (out / "drives.parquet").write_text("before")
    found = run_fleet(find_logs([str(fleet / "truck-2/cut.blf")]).logs, Config(), Serial())

    @contextmanager
    def full(path: Path) -> Iterator[Any]:
        with whole(path) as file:

            def write(content: bytes) -> None:
                file.write(content[:100])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

            yield SimpleNamespace(write=write, flush=file.flush) if "vehicles" in path.name else file

    monkeypatch.setattr("estimator.fleet.tables.whole", full)
    with pytest.raises(RoadloadError, match=r"vehicles\.parquet: cannot write: No space left on device"):
        output.write_fleet(found, Config(), out, 0.05, with_diagnosis=False)
    assert [path.name for path in out.iterdir() if path.is_file()] == ["drives.parquet"]
    assert (out / "drives.parquet").read_text() == "before"


def test_files_of_an_earlier_run_are_named(fleet: Path, tmp_path: Path) -> None:
    output.prepare(tmp_path)
    found = run_fleet(find_logs([str(fleet / "truck-2/cut.blf")]).logs, Config(), Serial())
    output.write_fleet(found, Config(), tmp_path, 0.05, with_diagnosis=True, with_page=True)
    (tmp_path / "priors/sold.toml").write_text("")
    written = output.write_fleet(found, Config(), tmp_path, 0.05)
    names = [str(path.relative_to(tmp_path)) for path in output.left_over(tmp_path, written)]
    assert names == ["effects.csv", "effects.parquet", "fleet.html", "priors/sold.toml"]


@pytest.mark.usefixtures("without_workers")
def test_a_run_into_the_folder_of_other_vehicles_says_that_their_tables_are_replaced(
    fleet: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    output.prepare(out)
    (out / "priors/sold.toml").write_text("")
    status, _, lines = ask(fleet / "truck-2/a.blf", "-o", out)
    assert status == 0
    assert lines[-1] == (
        f"note: {out}/priors/sold.toml: of an earlier run, whose tables this run replaced; give each run a folder of "
        "its own (-o), or delete what is not needed"
    )


def test_each_table_is_also_a_csv_file_of_the_same_columns_and_values(
    outputs: list[tuple[Path, dict[str, Any], list[str]]],
) -> None:
    import pyarrow.parquet

    out, answer, _ = outputs[0]
    for name in ("drives", "vehicles", "seasons", "road"):
        assert str(out / f"{name}.csv") in answer["files"]
        with (out / f"{name}.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        written = pyarrow.parquet.read_table(out / f"{name}.parquet")
        assert list(rows[0]) == written.schema.names
        for row, other in zip(rows, written.to_pylist(), strict=True):
            for column, value in other.items():
                if isinstance(value, float):
                    assert float(row[column]) == value
                elif isinstance(value, datetime):
                    assert row[column] == value.strftime("%Y-%m-%d %H:%M:%S")
                else:
                    assert row[column] == ("" if value is None else str(value))


@pytest.mark.parametrize("name", ["drives.csv", "drives.parquet", "fleet.JSON", "fleet.html"])
def test_a_folder_named_like_a_file_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"{name}: is named like a file; give the name of a folder"):
        output.prepare(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_folder_in_the_place_of_a_table_leaves_all_files_as_they_were(fleet: Path, tmp_path: Path) -> None:
    output.prepare(tmp_path)
    (tmp_path / "vehicles.parquet").mkdir()
    found = run_fleet(find_logs([str(fleet / "truck-2/cut.blf")]).logs, Config(), Serial())
    with pytest.raises(RoadloadError, match=r"vehicles\.parquet: is a folder; move it away"):
        output.write_fleet(found, Config(), tmp_path, 0.05, with_page=True)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_must_not_be_written_to_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("estimator.fleet.output.os.access", lambda path, mode: path.name != "cache")
    with pytest.raises(ConfigError, match=rf"{tmp_path}/cache: must not be written to; check its permissions"):
        output.prepare(tmp_path)
    with pytest.raises(ConfigError, match=r"/proc/fleet: cannot be made \(No such file.*\); give another folder"):
        output.prepare(Path("/proc/fleet"))


@pytest.mark.usefixtures("without_workers")
def test_a_run_that_can_use_no_log_writes_nothing_and_ends_with_status_2(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    logs = [fleet / "truck-2" / name for name in ("cut.blf", "idle.blf")]
    status, _, lines = ask(*logs, "-o", out)
    assert status == 2
    assert [line.split(":")[0] for line in lines] == ["failed", "unreadable", "error"]
    assert lines[2] == f"error: none of 2 logs can be used, for the reasons above; nothing was written to {out}"
    assert [path for path in out.rglob("*") if path.is_file()] == []


def test_a_wrong_configuration_is_told_before_a_folder_is_made(fleet: Path, tmp_path: Path) -> None:
    config = tmp_path / "own.toml"
    config.write_text('[sampler]\nlikelihood = "paper"\n')
    status, _, lines = ask(fleet, "-o", tmp_path / "out", "--config", config)
    assert (status, len(lines)) == (2, 1)
    assert not (tmp_path / "out").exists()


def test_bad_arguments_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.log").write_text("(1.0) can0 123#11\n")
    for arguments, reason in (
        ([tmp_path / "empty", "-o", tmp_path / "out"], "no logs there"),
        ([tmp_path / "a.log", "-o", tmp_path / "file"], "is a file"),
        ([tmp_path / "a.log", "-o", tmp_path / "out", "--vehicle", "x("], "no regular expression"),
    ):
        status, _, lines = ask(*arguments)
        assert status == 2
        assert len(lines) == 1
        assert reason in lines[0]


def test_what_is_no_address_of_a_scheduler_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """Dask tries for a minute, and then writes a traceback."""
    for address in ("nonsense", "foo://host:1", "tcp://host"):
        with pytest.raises(SystemExit) as refused:
            main(["fleet", "a.log", "-o", "out", "--scheduler", address])
        assert refused.value.code == 2
        assert f"'{address}' is not an address; write it as tcp://HOST:PORT" in capsys.readouterr().err


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("estimator.fleet.engine.SECONDS_TO_CONNECT", 1)
    with pytest.raises(RoadloadError, match="no Dask scheduler answers"), dask_engine("tcp://127.0.0.1:9", 1):
        pass


def test_a_cluster_without_workers_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("estimator.fleet.engine.SECONDS_TO_START", 1)
    with distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as empty:
        address = empty.scheduler_address
        reason = f"no worker took a task within 1 s; start one: dask worker {address}"
        with pytest.raises(RoadloadError, match=reason), dask_engine(address, 1):
            pass


@pytest.fixture(scope="module")
def worker() -> Iterator[Engine]:
    """An engine of one worker, which gives a task up at the first death."""
    pytest.importorskip("distributed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("estimator.fleet.engine.DEATHS", 0)
        with dask_engine(None, 1) as engine:
            yield engine


def test_a_worker_that_dies_costs_its_task_only(worker: Engine) -> None:
    answers = dict(worker.map(_fragile, [1, 0, 2, 13]))
    assert (answers[0], answers[2]) == (1, 2)
    assert isinstance(answers[1], Failure)
    assert answers[1].reason.startswith("ZeroDivisionError")
    assert isinstance(answers[3], Failure)
    assert answers[3].reason.startswith("1 workers died of it")


def test_a_worker_that_dies_with_a_result_that_was_not_fetched_yet_is_no_traceback() -> None:
    distributed = pytest.importorskip("distributed")

    class Lost:
        def exception(self) -> None:
            """It was done."""

        def result(self) -> None:
            raise distributed.KilledWorker("task", SimpleNamespace(address="tcp://127.0.0.1:9"), 1)

    answer = Distributed(SimpleNamespace(status="running"))._answer(Lost())
    assert isinstance(answer, Failure)
    assert answer.worker_died


def test_workers_keep_no_record_of_what_they_did(worker: Engine) -> None:
    """Dask's profiler keeps one for an hour, which grows by 0.3 MiB/s."""
    assert dict(worker.map(_is_profiled, [0])) == {0: False}


def _is_profiled(_: int) -> bool:
    from distributed import get_worker

    return "profile" in get_worker().periodic_callbacks


def _fragile(number: int) -> int:
    if number == 13:
        os._exit(1)
    return number * number // number


def test_logs_in_s3(fleet: Path, table: dict[str, Any]) -> None:
    moto = pytest.importorskip("moto.server")
    pytest.importorskip("s3fs")
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        _, port = server.get_host_and_port()
        options = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "test"}
        options |= {"AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}
        program = (
            "import sys, boto3; from estimator import estimate_drives, load_config;"
            "s3 = boto3.client('s3'); s3.create_bucket(Bucket='lake');"
            "s3.upload_file(sys.argv[1], 'lake', 'fleet/truck-2/a.blf');"
            "s3.upload_file(sys.argv[2], 'lake', 'fleet/truck-2/cut.blf');"
            "t = estimate_drives(['s3://lake/fleet/'], load_config());"
            "names = ('source', 'vehicle', 'status', 'mass_kg_mean');"
            "print(*sorted(' '.join(str(t[n][i]) for n in names) for i in range(len(t['source']))), sep=chr(10))"
        )
        logs = [str(fleet / "truck-2" / name) for name in ("a.blf", "cut.blf")]
        command = [sys.executable, "-c", program, *logs]
        answer = subprocess.run(command, env=os.environ | options, capture_output=True, text=True, timeout=120)
    finally:
        server.stop()
    assert answer.returncode == 0, answer.stderr
    assert [line.split()[:3] for line in answer.stdout.splitlines()] == [
        ["s3://lake/fleet/truck-2/a.blf", "truck-2", "estimated"],
        ["s3://lake/fleet/truck-2/cut.blf", "truck-2", "unreadable"],
    ]
    assert float(answer.stdout.split()[3]) == row(table, "truck-2/a.blf")["mass_kg_mean"]


def test_neither_the_daemon_nor_an_estimate_imports_the_fleet() -> None:
    program = (
        "import sys, estimator, estimator.daemon.service.assembly, estimator.commands.run, estimator.commands.estimate;"
        "print([m for m in sys.modules if m.startswith(('estimator.fleet', 'distributed', 'dask'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
