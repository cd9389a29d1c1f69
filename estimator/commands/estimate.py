"""The subcommand `estimate`: the answer straight from logs."""

import argparse
import importlib
from pathlib import Path
from types import ModuleType

from estimator.commands.arguments import add_output, add_settings
from estimator.commands.complaints import complain
from estimator.commands.interruption import until_interrupted
from estimator.commands.log_options import (
    RECORDED,
    add_channels,
    add_effects,
    add_map,
    add_seed,
    check_outputs,
    complain_of_channels,
    complain_of_databases,
    settings,
)
from estimator.commands.tables import print_run
from estimator.commands.terminal import print_json, progress_bar, standard_output
from estimator.errors import RoadloadError
from estimator.extras import how_to_install
from estimator.report import export, summary
from estimator.report.estimate_view import EstimateView, evidence_of, view_of
from estimator.report.page import document
from estimator.streaming import replay
from estimator.streaming.replay import Run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument("log", nargs="+", type=Path, metavar="LOG", help=RECORDED)
    add_channels(parser)
    add_map(parser)
    add_seed(parser, "sampler")
    parser.add_argument("--draws", type=Path, metavar="OUT.csv|.json|.nc", help="draws of the posterior")
    use = "the answer, and what it rests on; --report as in diagnose and fleet"
    parser.add_argument("--plot", "--report", type=Path, metavar="OUT.html|.png|.svg|.pdf", help=use)
    add_effects(parser)


def run(options: argparse.Namespace) -> int:
    """Estimate, write the files asked for, and print the answer."""
    outputs: dict[Path | None, tuple[str, ...]] = {options.draws: export.FORMATS}
    if options.plot is not None:
        outputs[options.plot] = (*document.FORMATS, *_picture_formats(options.plot))
    check_outputs(options.log, outputs)
    if options.draws is not None and options.draws.suffix.lower() == ".nc":
        export.require_arviz()
    chosen = settings(options)

    def work() -> Run:
        with progress_bar("estimating") as progress:
            return replay.estimate_logs(options.log, chosen, progress)

    result, status = until_interrupted(work)
    evidence = evidence_of(result)
    if evidence is not None and options.draws is not None:
        export.write_draws(evidence, options.draws, result.final.withheld)
    if evidence is None and options.draws is not None:
        complain("note: no estimate, so no draws were written")
    if options.plot is not None:
        _write_plot(view_of(result, ", ".join(path.name for path in options.log)), options.plot)
    complain_of_channels(result.mixed_channels)
    complain_of_databases(settings(options))
    if options.json:
        print_json(summary.of_run(result))
    else:
        print_run(standard_output(), result)
    return status


def _write_plot(view: EstimateView, path: Path) -> None:
    if path.suffix.lower() in document.FORMATS:
        _page().write_page(view, path)
    else:
        _plots().write_plot(view, path)


def _picture_formats(path: Path) -> tuple[str, ...]:
    """Suffixes of pictures; none for a page, which needs no matplotlib."""
    formats: tuple[str, ...] = () if path.suffix.lower() in document.FORMATS else _plots().FORMATS
    return formats


def _page() -> ModuleType:
    """Import the module that writes a page, for ``--plot`` only: its tables are those of a diagnosis, and import it."""
    return importlib.import_module("estimator.report.estimate_page")


def _plots() -> ModuleType:
    """The module that draws; it needs matplotlib, so it is imported for ``--plot`` only."""
    try:
        return importlib.import_module("estimator.report.plots")
    except ImportError as error:
        raise RoadloadError(f"--plot needs matplotlib, but for .html: {how_to_install('plot')}") from error
