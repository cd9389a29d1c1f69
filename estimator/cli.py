"""The `roadload` command: one function a subcommand, and the only place that prints."""

import argparse
import dataclasses
import importlib
import json
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, get_args

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress as Bar

from estimator import __version__, config, inspection, replay, summary
from estimator.can_io.logs import FORMATS
from estimator.can_io.recorder import WRITABLE, frames_of, write_log
from estimator.cli_daemon import add_commands as add_daemon_commands
from estimator.cli_diagnosis_tables import print_diagnosis
from estimator.cli_tables import print_inspection, print_run
from estimator.config import Config
from estimator.diagnosing import diagnose_logs
from estimator.diagnosis_summary import of_diagnosis
from estimator.effects import CATALOGUE
from estimator.errors import ConfigError, RoadloadError
from estimator.report import diagnosis_page, export
from estimator.report.files import check_suffix
from estimator.signals import Role
from estimator.simulation.cycle import COLUMNS, cycle_route
from estimator.simulation.effects.catalogue import KINDS, parse_effect
from estimator.simulation.itinerary import Shape, shaped
from estimator.simulation.recording import record
from estimator.simulation.route import RoadKind, generate_route
from estimator.simulation.sensors import OPTIONAL, Sensors
from estimator.simulation.truck import draw_truck

WIDE = 140  # columns of tables that go to a file or a pipe
METRES_PER_MINUTE = 2000.0  # of simulated road: nobody drives a truck faster, so the road never ends


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status: 0, 2 for bad input, 1 for a run that could not finish."""
    options = _parser().parse_args(arguments)
    # python-can logs what it cannot parse; the log readers raise or count it themselves.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        status: int = options.run(options)
        sys.stdout.flush()
    except RoadloadError as error:
        if options.debug:
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        # Whoever read our output has gone; keep the interpreter from complaining about it at exit.
        sys.stderr.close()
        return 1
    except OSError as error:
        if options.debug:
            raise
        print(f"error: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 1
    return status


class Parser(argparse.ArgumentParser):
    """Argument parser whose complaints are one line too."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the command line and where to read on; exit status 2."""
        print(f"error: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="roadload", description="Vehicle mass, rolling resistance and drag from CAN.")
    parser.add_argument("--version", action="version", version=f"roadload {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    shown = Parser(add_help=False)
    shown.add_argument("--json", action="store_true", help="one JSON object on standard output")
    shown.add_argument("--debug", action="store_true", help="show a traceback on errors")
    common = Parser(add_help=False, parents=[shown])
    common.add_argument("--config", type=Path, metavar="FILE.toml", help="settings and signal binding")
    common.add_argument("--dbc", action="append", metavar="FILE.dbc", help="instead of the configuration's databases")

    logs = f"recorded traffic: {' '.join(FORMATS)}"
    played = commands.add_parser("replay", parents=[common], help="play logs on a virtual bus to the gateway's loop")
    played.add_argument("log", nargs="+", type=Path, metavar="LOG", help=logs)
    played.add_argument("--speed", default="max", metavar="max|FACTOR", help="multiple of real time (default: max)")
    played.add_argument(
        "--output", type=Path, metavar="OUT.blf", help=f"record what was broadcast: {' '.join(WRITABLE)}"
    )
    played.add_argument("--seed", type=_seed, help="of the sampler, instead of the configuration's")
    played.set_defaults(run=_replay)

    estimated = commands.add_parser("estimate", parents=[common], help="the same answer from logs without a bus")
    estimated.add_argument("log", nargs="+", type=Path, metavar="LOG", help=logs)
    estimated.add_argument("--seed", type=_seed, help="of the sampler, instead of the configuration's")
    estimated.add_argument("--draws", type=Path, metavar="OUT.csv|.json|.nc", help="draws of the posterior")
    estimated.add_argument(
        "--plot", type=Path, metavar="OUT.png|.svg|.pdf|.html", help="posterior, fit, coverage, chains"
    )
    beyond = f"add an effect to the model, again and again: {', '.join(e.name for e in CATALOGUE if e.streams)}"
    estimated.add_argument("--effect", action="append", default=[], metavar="NAME", help=beyond)
    estimated.set_defaults(run=_estimate)

    diagnosed = commands.add_parser("diagnose", parents=[common], help="where the model is wrong, why, and by how much")
    diagnosed.add_argument("log", nargs="+", type=Path, metavar="LOG", help=f"drives of one vehicle; {logs}")
    diagnosed.add_argument("--report", type=Path, metavar="OUT.html", help="one page with figures, opens offline")
    diagnosed.add_argument("--effect", action="append", default=[], metavar="NAME", help=beyond)
    diagnosed.add_argument("--seed", type=_seed, help="of the bootstrap, instead of the configuration's")
    diagnosed.set_defaults(run=_diagnose)

    inspected = commands.add_parser("inspect", parents=[common], help="what is in a log")
    inspected.add_argument("log", type=Path, metavar="LOG", help=logs)
    inspected.set_defaults(run=_inspect)

    add_daemon_commands(commands, common, shown)

    simulated = commands.add_parser("simulate", parents=[shown], help="drive a simulated truck and write a log")
    simulated.add_argument("output", type=Path, metavar="OUT.blf", help=f"the log: {' '.join(WRITABLE)}")
    simulated.add_argument("--minutes", type=_minutes, default=40.0, help="length of the drive (default: 40)")
    simulated.add_argument("--route", choices=get_args(RoadKind), default="mixed", help="kind of road (default: mixed)")
    simulated.add_argument("--cycle", type=Path, metavar="FILE.csv", help=f"road of a driving cycle instead: {COLUMNS}")
    simulated.add_argument("--shape", choices=get_args(Shape), default="one-way", help="how the road is driven")
    simulated.add_argument("--seed", type=_seed, default=1, help="draws truck, route and noise (default: 1)")
    for name, unit, what in (("mass", "kg", "mass"), ("A", "N", "rolling force"), ("C", "N s2/m2", "drag coefficient")):
        simulated.add_argument(f"--{name}", type=_positive, metavar=unit, help=f"{what}, instead of the drawn one")
    noise = "sd of the wheel speed's noise (default: 0.01)"
    simulated.add_argument("--speed-noise", type=_not_negative, default=0.01, metavar="m/s", help=noise)
    steps = "of the reference torque, in which torque is sent: 0.125 (default) or 1"
    simulated.add_argument("--torque-resolution", type=float, choices=[0.125, 1.0], default=0.125, help=f"%% {steps}")
    lag = "by which torque and engine speed are late (default: 0.03)"
    simulated.add_argument("--torque-lag", type=_not_negative, default=0.03, metavar="s", help=lag)
    simulated.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="NAME[=SIZE][@START[-END]]",
        help=f"make the world differ, again and again; sizes in SI, times in s: {', '.join(KINDS)}",
    )
    simulated.add_argument(
        "--without",
        action="append",
        default=[],
        choices=[role.value for role in OPTIONAL],
        metavar="SIGNAL",
        help=f"leave a signal off the bus: {', '.join(OPTIONAL)}",
    )
    simulated.set_defaults(run=_simulate)
    return parser


def _number(low: float, high: float, what: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return parse


_positive = _number(sys.float_info.min, sys.float_info.max, "a positive number")
_not_negative = _number(0.0, sys.float_info.max, "a number that is not negative")
_minutes = _number(0.5, 10_000.0, "a number of minutes from 0.5 to 10000")


def _seed(text: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number that is not negative")
    return int(text)


def _check_outputs(options: argparse.Namespace, outputs: dict[Path | None, tuple[str, ...]]) -> None:
    """Refuse what cannot be written, and what would overwrite an input, before the work is done."""
    inputs = {path.resolve() for path in options.log}
    for path, formats in outputs.items():
        if path is not None:
            check_suffix(path, formats)
            if path.resolve() in inputs:
                raise ConfigError(f"{path}: is a log to be read; write to another file")


def _settings(options: argparse.Namespace) -> Config:
    """The configuration file, with what the command line puts in its place."""
    settings = config.load(options.config)
    if options.dbc:
        settings = config.replace(settings, bus=msgspec.structs.replace(settings.bus, dbc=options.dbc))
    if getattr(options, "effect", None):
        settings = msgspec.structs.replace(settings, effects=[*settings.effects, *options.effect])
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
    _check_outputs(options, {options.output: WRITABLE})
    speed = None
    if options.speed != "max":
        try:
            speed = _positive(options.speed)
        except argparse.ArgumentTypeError as error:
            raise ConfigError(f"--speed: {options.speed!r} is neither 'max' nor a positive factor") from error
    with _progress("replaying") as progress:
        run = replay.replay(options.log, _settings(options), progress, speed, options.output)
    return _report(run, options)


def _estimate(options: argparse.Namespace) -> int:
    outputs: dict[Path | None, tuple[str, ...]] = {options.draws: export.FORMATS}
    if options.plot is not None:
        outputs[options.plot] = _plots().FORMATS
    _check_outputs(options, outputs)
    if options.draws is not None and options.draws.suffix.lower() == ".nc":
        export.require_arviz()
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


def _diagnose(options: argparse.Namespace) -> int:
    _check_outputs(options, {options.report: diagnosis_page.FORMATS})
    with _progress("diagnose") as progress:
        diagnosis = diagnose_logs(options.log, _settings(options), progress)
    if options.report is not None:
        diagnosis_page.write_page(diagnosis, options.report)
    if options.json:
        _print_json(of_diagnosis(diagnosis))
    else:
        print_diagnosis(_console(), diagnosis)
    return 0


def _inspect(options: argparse.Namespace) -> int:
    with _progress("reading") as progress:
        content = inspection.inspect(options.log, _settings(options), progress)
    if options.json:
        _print_json(content)
    else:
        print_inspection(_console(), content)
    return 0


def _simulate(options: argparse.Namespace) -> int:
    check_suffix(options.output, WRITABLE)
    effects = [parse_effect(text) for text in options.effect]
    rng = np.random.default_rng(options.seed)
    drawn = draw_truck(rng)
    chosen = {name: getattr(options, name) for name in ("mass", "A", "C") if getattr(options, name) is not None}
    truck = dataclasses.replace(drawn, **chosen)
    duration = options.minutes * 60
    length = options.minutes * METRES_PER_MINUTE
    road = cycle_route(options.cycle, length, rng) if options.cycle else generate_route(options.route, length, rng)
    sensors = Sensors(
        speed_noise=options.speed_noise,
        torque_resolution=options.torque_resolution / 100,
        torque_lag=options.torque_lag,
        without=frozenset(Role(name) for name in options.without),
    )
    route = shaped(road, duration, options.shape)
    recording = record(truck, route, duration, rng, sensors=sensors, effects=effects)
    frames = frames_of(recording.signals)
    write_log(frames, options.output)
    told = recording.describe()
    if options.json:
        _print_json({"log": str(options.output), "frames": len(frames), "duration_s": duration, **told})
    else:
        road_name = options.cycle.name if options.cycle else options.route
        print(f"{options.output}: {len(frames):,} frames, {options.minutes:g} min of {road_name} driving")
        print(f"truth: mass {truck.mass:,.0f} kg, A {truck.A:,.0f} N, C {truck.C:.3f} N s²/m²")
        for effect in told["effects"]:
            size = f"{effect['magnitude']:g} {effect['unit']}".removesuffix(" 1")
            print(f"effect: {effect['name']} {size}, {effect['rms_kW']:.1f} kW rms")
    return 0
