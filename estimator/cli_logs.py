"""The subcommands that read logs: `replay`, `estimate`, `diagnose` and `inspect`."""

import argparse
import importlib
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import Progress as Bar

from estimator import config, inspection, replay, summary
from estimator.can_io.logs import FORMATS
from estimator.can_io.recorder import WRITABLE
from estimator.cli_arguments import positive, seed
from estimator.cli_diagnosis_tables import print_diagnosis
from estimator.cli_tables import print_inspection, print_run
from estimator.config import Config
from estimator.diagnosing import diagnose_logs
from estimator.diagnosis_summary import of_diagnosis
from estimator.effects import CATALOGUE
from estimator.errors import ConfigError, RoadloadError
from estimator.report import diagnosis_page, export
from estimator.report.files import check_suffix

WIDE = 140  # columns of tables that go to a file or a pipe


def add_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    """Add the subcommands; ``common`` has --config, --dbc, --json and --debug."""
    logs = f"recorded traffic: {' '.join(FORMATS)}"
    played = commands.add_parser("replay", parents=[common], help="play logs on a virtual bus to the gateway's loop")
    played.add_argument("log", nargs="+", type=Path, metavar="LOG", help=logs)
    played.add_argument("--speed", default="max", metavar="max|FACTOR", help="multiple of real time (default: max)")
    played.add_argument(
        "--output", type=Path, metavar="OUT.blf", help=f"record what was broadcast: {' '.join(WRITABLE)}"
    )
    played.add_argument("--seed", type=seed, help="of the sampler, instead of the configuration's")
    played.set_defaults(run=_replay)

    estimated = commands.add_parser("estimate", parents=[common], help="the same answer from logs without a bus")
    estimated.add_argument("log", nargs="+", type=Path, metavar="LOG", help=logs)
    estimated.add_argument("--seed", type=seed, help="of the sampler, instead of the configuration's")
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
    diagnosed.add_argument("--seed", type=seed, help="of the bootstrap, instead of the configuration's")
    diagnosed.set_defaults(run=_diagnose)

    inspected = commands.add_parser("inspect", parents=[common], help="what is in a log")
    inspected.add_argument("log", type=Path, metavar="LOG", help=logs)
    inspected.set_defaults(run=_inspect)


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
    config.check(settings)
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
            speed = positive(options.speed)
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
