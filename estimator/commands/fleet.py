"""The subcommand `fleet`: many logs to one table of drives and one of vehicles."""

import argparse
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from estimator.answers.fleet import FleetAnswer
from estimator.columns import Row
from estimator.commands.arguments import add_output, add_settings, number
from estimator.commands.complaints import complain
from estimator.commands.log_options import (
    add_channels,
    add_effects,
    add_map,
    add_seed,
    complain_of_databases,
    settings,
)
from estimator.commands.terminal import print_json, progress_bar, say, standard_output
from estimator.errors import ConfigError, InputError
from estimator.fleet.cache import Cache
from estimator.fleet.engine import dask_engine
from estimator.fleet.output import CACHE, PAGE, check_names, left_over, prepare, write_fleet
from estimator.fleet.rows import drive_rows, vehicle_rows
from estimator.fleet.run import Fleet, check, run_fleet
from estimator.fleet.sources import Found, LogFile, find_logs
from estimator.fleet.tables import UNUSED, doubts, require_arrow
from estimator.report.number_format import counted, with_sd
from estimator.report.parameter_text import COEFFICIENTS
from estimator.streaming.log_frames import Kind, kind_of

SOURCES = "logs, folders, globs, lists of logs (.txt) or URLs (s3://bucket/folder)"

MAX_LISTED = 5  # files in a line
BY_ENGINE = "NAME"  # instead of a regular expression for the vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument("source", nargs="+", metavar="SOURCE", help=SOURCES)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder of the tables")
    vehicle = (
        f"its first group names the vehicle in the path of a log; or {BY_ENGINE}, of the engine on the bus (J1939)"
    )
    parser.add_argument("--vehicle", metavar="REGEX", help=vehicle)
    engine = parser.add_mutually_exclusive_group()
    engine.add_argument("--workers", type=_workers, metavar="N", help="processes; as many as there are cores")
    engine.add_argument(
        "--scheduler", type=_address, metavar="tcp://HOST:PORT", help="a Dask cluster, instead of processes"
    )
    parser.add_argument("--diagnose", action="store_true", help="diagnose each drive too; takes much longer")
    parser.add_argument("--report", action="store_true", help=f"also one page with figures, OUT/{PAGE}, opens offline")
    rate = number(0.0, 1.0, "a rate from 0 to 1")
    parser.add_argument("--fdr", type=rate, default=0.05, metavar="RATE", help="false-discovery rate of outliers: 0.05")
    add_channels(parser)
    add_map(parser)
    add_seed(parser, "sampler")
    add_effects(parser)


def run(options: argparse.Namespace) -> int:
    """Estimate the fleet, write the tables, and print what came of it."""
    config = settings(options)
    require_arrow()
    are_named = options.vehicle == BY_ENGINE
    files = find_logs(options.source, None if are_named else options.vehicle, kind_of(config))
    logs, left_out = _inputs(files, options.output)
    check(config)
    complain_of_databases(config)
    _complain_of_others(left_out, kind_of(config))
    if not are_named:
        check_names(log.vehicle for log in logs)
    prepare(options.output)
    cache = Cache.of(options.output / CACHE, config, options.diagnose)
    with progress_bar("fleet") as progress, dask_engine(options.scheduler, options.workers) as engine:
        found = run_fleet(
            logs,
            config,
            engine,
            cache=cache,
            with_diagnosis=options.diagnose,
            are_named=are_named,
            progress=progress,
        )
    drives, vehicles = drive_rows(found), vehicle_rows(found, options.fdr)
    _complain_of(drives, vehicles)
    if all(row["status"] in UNUSED for row in drives):
        nothing = f"none of {counted(len(logs), 'log')} can be used, for the reasons above"
        raise InputError(f"{nothing}; nothing was written to {options.output}")
    written = write_fleet(
        found, config, options.output, options.fdr, with_diagnosis=options.diagnose, with_page=options.report
    )
    if earlier := left_over(options.output, written):
        those = f"{_listed(earlier)}: of an earlier run, whose tables this run replaced"
        complain(f"note: {those}; give each run a folder of its own (-o), or delete what is not needed")
    if options.json:
        print_json(_summary(found, drives, vehicles, written, len(left_out)))
    else:
        _print(drives, vehicles, options.output)
    return 0


def _workers(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes from 1 to 1000")
    return int(text)


def _address(text: str) -> str:
    if not re.fullmatch(r"(tcp|tls)://[^/\s]+:\d{1,5}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not an address; write it as tcp://HOST:PORT")
    return text


def _complain_of(drives: Sequence[Row], vehicles: Sequence[Row]) -> None:
    """One line for each log that was left out, each doubtful clock and each vehicle that was not joined."""
    for row in drives:
        if row["status"] in UNUSED:
            complain(f"{row['status']}: {row['reason']}")
    for doubt in doubts(drives, vehicles):
        complain(f"note: {doubt}")


def _complain_of_others(left_out: Sequence[str], kind: Kind) -> None:
    """One line for all files that are logs with other settings only."""
    if left_out:
        those = f"{counted(len(left_out), 'file')}: {_listed(left_out)}"
        remedy = f"read them {kind.remedy}, in a run of their own"
        complain(f"note: {kind.others_are} left out, {those}; {remedy}")


def _inputs(files: Found, out: Path) -> tuple[list[LogFile], list[str]]:
    """Logs and left-out files but those of earlier runs, in ``out`` or in other folders of the source."""
    folders = {Path(path).parent for path in (*files.left_out, *(log.source for log in files.logs))}
    outs = [out, *(folder for folder in folders if (folder / CACHE).is_dir())]
    own = {os.path.realpath(path) for folder in outs for path in left_over(folder, ())}
    logs = [log for log in files.logs if os.path.realpath(log.source) not in own]
    written = {os.path.realpath(path) for path in left_over(out, ())}
    if not (out / CACHE).is_dir() and any(os.path.realpath(log.source) in written for log in files.logs):
        raise ConfigError(f"{out}: has logs with the names of tables of a fleet; give another folder with -o")
    if not logs:
        raise InputError("no logs there but tables of an earlier run; give the logs as SOURCE")
    return logs, [path for path in files.left_out if os.path.realpath(path) not in own]


def _listed(paths: Sequence[Path | str]) -> str:
    more = f" and {len(paths) - MAX_LISTED} more" if len(paths) > MAX_LISTED else ""
    return ", ".join(map(str, paths[:MAX_LISTED])) + more


def _summary(
    found: Fleet, drives: Sequence[Row], vehicles: Sequence[Row], written: Sequence[Path], left_out: int
) -> FleetAnswer:
    return FleetAnswer(
        drives=len(found.grouped.drives),
        rows=dict(Counter(row["status"] for row in drives)),
        vehicles=len(vehicles),
        vehicles_estimated=sum(row["status"] == "estimated" for row in vehicles),
        outliers={row["vehicle"]: row["outlier"] for row in vehicles if row["outlier"]},
        files=tuple(map(str, written)),
        left_out=left_out,
    )


def _print(drives: Sequence[Row], vehicles: Sequence[Row], out: Path) -> None:
    console = standard_output()
    estimated = sum(row["status"] == "estimated" for row in drives)
    rows = f"{counted(len(drives), 'row')} of drives, {estimated:,} estimated"
    say(
        console,
        f"{rows}; {counted(len(vehicles), 'vehicle')}; written to {out} (for a spreadsheet: drives.csv, vehicles.csv)",
    )
    for row in vehicles:
        line = f"{row['vehicle']}: {counted(row['drives'], 'drive')}, {road_load(row)}"
        say(console, line + (f"; out of line: {row['outlier']}" if row["outlier"] else ""))


def road_load(row: Row) -> str:
    """A/m and C of a vehicle with their standard deviations, or why there are none."""
    rolling, drag = row["A_per_mass_reason"], row["C_reason"]
    if rolling and rolling == drag:
        return f"A/m and C unestimated ({rolling})"
    A, C = _value(row, "A_per_mass_N_kg", "N/kg", rolling), _value(row, "C_N_s2_m2", "N s²/m²", drag)
    c_rr, c_d_A = (
        "" if reason else f" ({x.name} {x.value(row[f'{x.key}_mean'])})"
        for x, reason in zip(COEFFICIENTS, (rolling, drag), strict=True)
    )
    return f"A/m {A}{c_rr}, C {C}{c_d_A}"


def _value(row: Row, name: str, unit: str, reason: str) -> str:
    return f"unestimated ({reason})" if reason else with_sd(row[f"{name}_mean"], row[f"{name}_sd"], unit)
