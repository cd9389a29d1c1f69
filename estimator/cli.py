"""The `roadload` command: one function a subcommand, and the only place that prints."""

import argparse
import dataclasses
import importlib
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress as Bar
from rich.table import Table

from estimator import __version__, config, inspection, replay, summary
from estimator.can_io.recorder import frames_of, write_log
from estimator.config import Config
from estimator.errors import ConfigError, RoadloadError
from estimator.report import export
from estimator.report.files import check_suffix
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck
from estimator.tables import print_inspection, print_run

WIDE = 140  # columns of tables that go to a file or a pipe
METRES_PER_MINUTE = 2000.0  # of simulated road: nobody drives a truck faster, so the road never ends


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status: 0, 2 for bad input, 1 for a run that could not finish."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except RoadloadError as error:
        if options.debug:
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # Whoever read our output has gone; keep the interpreter from complaining about it at exit.
        sys.stderr.close()
        return 1
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="roadload", description="Vehicle mass, rolling resistance and drag from CAN.")
    parser.add_argument("--version", action="version", version=f"roadload {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--config", type=Path, metavar="FILE.toml", help="settings and signal binding")
    common.add_argument("--dbc", action="append", metavar="FILE.dbc", help="instead of the configuration's databases")
    common.add_argument("--json", action="store_true", help="one JSON object on standard output")
    common.add_argument("--debug", action="store_true", help="show a traceback on errors")

    played = commands.add_parser("replay", parents=[common], help="play logs on a virtual bus through the daemon")
    played.add_argument("log", nargs="+", type=Path, metavar="LOG")
    played.add_argument("--speed", default="max", metavar="max|FACTOR", help="multiple of real time (default: max)")
    played.add_argument("--output", type=Path, metavar="OUT.blf", help="record what was broadcast")
    played.add_argument("--seed", type=_seed, help="of the sampler, instead of the configuration's")
    played.set_defaults(run=_replay)

    estimated = commands.add_parser("estimate", parents=[common], help="the same answer from logs without a bus")
    estimated.add_argument("log", nargs="+", type=Path, metavar="LOG")
    estimated.add_argument("--seed", type=_seed, help="of the sampler, instead of the configuration's")
    estimated.add_argument("--draws", type=Path, metavar="OUT.csv|.json|.nc", help="draws of the posterior")
    estimated.add_argument("--plot", type=Path, metavar="OUT.png|.svg|.html", help="posterior, fit, coverage, chains")
    estimated.set_defaults(run=_estimate)

    inspected = commands.add_parser("inspect", parents=[common], help="what is in a log")
    inspected.add_argument("log", type=Path, metavar="LOG")
    inspected.set_defaults(run=_inspect)

    simulated = commands.add_parser("simulate", parents=[common], help="drive a simulated truck and write a log")
    simulated.add_argument("output", type=Path, metavar="OUT.blf", help="the log: .blf .asc .log .csv .trc")
    simulated.add_argument("--minutes", type=_positive, default=40.0, help="length of the drive (default: 40)")
    simulated.add_argument("--route", choices=["urban", "mixed", "highway"], default="mixed")
    simulated.add_argument("--seed", type=_seed, default=1, help="draws truck, route and noise (default: 1)")
    for name, unit, what in (("mass", "kg", "mass"), ("A", "N", "rolling force"), ("C", "N s2/m2", "drag coefficient")):
        simulated.add_argument(f"--{name}", type=_positive, metavar=unit, help=f"{what}, instead of the drawn one")
    simulated.add_argument("--speed-noise", type=float, default=0.01, metavar="m/s", help="sd (default: 0.01)")
    simulated.set_defaults(run=_simulate)
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _settings(options: argparse.Namespace) -> Config:
    """The configuration file, with what the command line puts in its place."""
    settings = config.load(options.config)
    if options.dbc:
        settings = config.replace(settings, bus=msgspec.structs.replace(settings.bus, dbc=options.dbc))
    if getattr(options, "seed", None) is not None:
        settings = config.replace(settings, sampler=msgspec.structs.replace(settings.sampler, seed=options.seed))
    return settings


@contextmanager
def _progress(label: str) -> Iterator[replay.Progress]:
    """A bar on standard error where that is a terminal, nothing elsewhere."""
    console = Console(stderr=True)
    with Bar(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def _console() -> Console:
    """Standard output; what is not a terminal has no width to keep to."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDE)


def _print_json(content: dict[str, Any]) -> None:
    print(json.dumps(content, indent=2, allow_nan=False))


def _report(run: replay.Run, options: argparse.Namespace) -> int:
    if options.json:
        _print_json(summary.of_run(run))
    else:
        print_run(_console(), run)
    return 0


def _replay(options: argparse.Namespace) -> int:
    speed = None
    if options.speed != "max":
        try:
            speed = _positive(options.speed)
        except (ValueError, argparse.ArgumentTypeError) as error:
            raise ConfigError(f"--speed: {options.speed!r} is neither 'max' nor a positive factor") from error
    with _progress("replaying") as progress:
        run = replay.replay(options.log, _settings(options), progress, speed, options.output)
    return _report(run, options)


def _estimate(options: argparse.Namespace) -> int:
    if options.draws is not None:
        check_suffix(options.draws, export.FORMATS)
    if options.plot is not None:
        check_suffix(options.plot, _plots().FORMATS)
    with _progress("estimating") as progress:
        run = replay.estimate(options.log, _settings(options), progress)
    evidence = run.pipeline.estimator.evidence
    if evidence is not None and options.draws is not None:
        export.write_draws(evidence, options.draws)
    if evidence is not None and options.plot is not None:
        _plots().write_plot(evidence, f"roadload: {', '.join(path.name for path in options.log)}", options.plot)
    if evidence is None and (options.draws or options.plot):
        print("note: no estimate, so no draws and no picture were written", file=sys.stderr)
    return _report(run, options)


def _plots() -> ModuleType:
    """The room that draws, which needs matplotlib: loaded only when a picture is asked for."""
    try:
        return importlib.import_module("estimator.report.plots")
    except ImportError as error:
        raise RoadloadError("--plot needs matplotlib: pip install 'roadload[plot]'") from error


def _inspect(options: argparse.Namespace) -> int:
    with _progress("reading") as progress:
        content = inspection.inspect(options.log, _settings(options), progress)
    if options.json:
        _print_json(content)
    else:
        print_inspection(_console(), content)
    return 0


def _simulate(options: argparse.Namespace) -> int:
    rng = np.random.default_rng(options.seed)
    drawn = draw_truck(rng)
    chosen = {name: getattr(options, name) for name in ("mass", "A", "C") if getattr(options, name) is not None}
    truck = dataclasses.replace(drawn, **chosen)
    duration = options.minutes * 60
    route = generate_route(options.route, options.minutes * METRES_PER_MINUTE, rng)
    recording = record(truck, route, duration, rng, sensors=Sensors(speed_noise=options.speed_noise))
    frames = frames_of(recording.signals)
    write_log(frames, options.output)
    truth = {
        "log": str(options.output),
        "frames": len(frames),
        "duration_s": duration,
        "truth": {"mass_kg": truck.mass, "A_N": truck.A, "C_N_s2_m2": truck.C},
        "effects": [],
    }
    if options.json:
        _print_json(truth)
    else:
        table = Table("parameter", "truth")
        table.add_row("mass", f"{truck.mass:,.0f} kg")
        table.add_row("A", f"{truck.A:,.0f} N")
        table.add_row("C", f"{truck.C:.3f} N s²/m²")
        console = _console()
        console.print(f"{options.output}: {len(frames):,} frames, {options.minutes:g} min of {options.route} driving")
        console.print(table)
    return 0
