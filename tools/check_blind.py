"""The blind check of the diagnosis: drives whose effects are drawn and sealed, diagnosed from their logs, then scored.

    python tools/check_blind.py generate out/blind --drives 600 --seed 1        # OUT/logs and OUT/sealed
    python tools/check_blind.py diagnose out/blind                              # OUT/answers, from the logs alone
    python tools/check_blind.py score out/blind --drives 600 --seed 1 [--out]   # results/blind.json
    python tools/check_blind.py peers out/blind --drives 600 --seed 1 [--out]   # with tools/peers/naming.txt

The drives come from the simulated truck: a forward simulation in time that shares no formula with the diagnosis.
`blind/seal.py` describes how truths are sealed, `blind/oracle.py` how the visibility of an effect is computed. It is
visible where an oracle that knows its true shape, times and noise has a log Bayes factor above 10.
"""

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from blind import diagnose, draw, score, seal, tables, world
from blind.truth import Truth
from harness.check import Cells, Check, Figures, Table, drive_options, progress

from estimator.errors import InputError, RoadloadError


def plans_of(options: argparse.Namespace) -> list[draw.Plan]:
    """The drives that are drawn by the options."""
    return draw.draw(options.drives, options.seed, options.minutes, options.hilly, options.only)


def generate(options: argparse.Namespace) -> int:
    """Draw drives, write their logs, seal the truth."""
    plans = plans_of(options)
    for _ in progress(world.make_all(plans, options.seed, options.folder, options.workers), "driving", len(plans)):
        pass
    return 0


def diagnosed(options: argparse.Namespace) -> int:
    """Diagnose every log with `roadload diagnose`."""
    runs = diagnose.diagnose_all(options.folder, options.workers)
    failed = [run for run in progress(runs, "diagnosing", len(seal.drives(options.folder))) if run.answer is None]
    for run in failed:
        print(f"{run.drive}: {run.error}", file=sys.stderr)
    return int(bool(failed))


def truths(options: argparse.Namespace) -> dict[str, Truth]:
    """The unsealed truths by drive.

    Raises
    ------
    InputError
        The folder does not hold the drives of the options.
    """
    sealed = seal.unseal(options.folder)
    masses = {plan.drive: plan.truck.mass for plan in plans_of(options)}
    if {drive: truth.parameters["mass_kg"] for drive, truth in sealed.items()} != masses:
        raise InputError(f"{options.folder}: holds other drives; give the options with which they were generated")
    return sealed


def scored(options: argparse.Namespace) -> Figures:
    """Check the seal and score the answers."""
    return asdict(score.score(score.pair(truths(options), diagnose.answers(options.folder))))


def compared(options: argparse.Namespace) -> Figures:
    """Measures of naming by published methods on the same drives."""
    try:
        from peers import naming
    except ImportError as error:
        raise RoadloadError(f"{error.name} is missing; install tools/peers/naming.txt") from error
    return naming.compare(truths(options), options.folder, options.workers)


def compared_tables(figures: Figures) -> list[Table]:
    """Measures of naming, one column a method."""
    rows = [[tables.row(one) for one in measures] for measures in zip(*figures.values(), strict=True)]
    cells = [[*first[:2], *(f"{row[2]} ({row[3]})" for row in (first, *others))] for first, *others in rows]
    return [Table("", ("measure", "goal", *figures), cells)]


def folder_options(parser: argparse.ArgumentParser) -> None:
    """Add the folder and the processes."""
    parser.add_argument("folder", type=Path, metavar="OUT")
    parser.add_argument("--workers", type=int, default=2)


def drawn_options(parser: argparse.ArgumentParser) -> None:
    """Add the folder, and what is drawn."""
    folder_options(parser)
    drive_options(drives=600, minutes=75.0)(parser)
    hilly = "share of drives in hills, with the grade in the configuration"
    parser.add_argument("--hilly", type=float, default=0.0, help=hilly)
    parser.add_argument("--only", choices=list(draw.MIX), help="drives of one kind")


CHECKS = {
    "score": Check(
        title="Diagnosis of drives whose truth is sealed",
        first="score out/blind",
        measure=scored,
        tables=tables.tables,
        headline=tables.HEADLINE,
        options=drawn_options,
    ),
    "peers": Check(
        part="peers",
        title="Published methods of naming on the same drives",
        first="peers out/blind",
        measure=compared,
        tables=compared_tables,
        headline=Cells(rows=tables.HEADLINE.rows),
        options=drawn_options,
    ),
}


def main(arguments: list[str]) -> int:
    """Run one of the steps."""
    if arguments and arguments[0] in CHECKS:
        return CHECKS[arguments[0]].main(arguments[1:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(required=True, metavar="generate|diagnose|score|peers")
    generated = steps.add_parser("generate", help="draw drives, write their logs, seal the truth")
    drawn_options(generated)
    generated.set_defaults(run=generate)
    answered = steps.add_parser("diagnose", help="diagnose every log with `roadload diagnose`")
    folder_options(answered)
    answered.set_defaults(run=diagnosed)
    options = parser.parse_args(arguments)
    try:
        return int(options.run(options))
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
