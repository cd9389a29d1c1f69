"""The blind check of the diagnosis: drives whose effects are drawn and sealed, diagnosed from their logs, then scored.

    python tools/blind_check.py generate out/blind --drives 600 --seed 1   # OUT/logs and OUT/sealed
    python tools/blind_check.py diagnose out/blind                         # OUT/answers, from the logs alone
    python tools/blind_check.py score out/blind --markdown docs/blind_check.md
    python tools/blind_check.py peers out/blind                            # in the environment of blind_peers.txt

The drives come from the simulated truck: a forward simulation in time that shares no formula with the diagnosis.
`blind/seal.py` describes how truths are sealed, `blind/oracle.py` how the visibility of an effect is computed.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

from blind import diagnose, draw, score, seal, tables, world
from rich.console import Console
from rich.progress import track

from estimator.errors import RoadloadError


def main(arguments: list[str] | None = None) -> int:
    """Run one of the steps."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except (seal.SealError, RoadloadError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = parser.add_subparsers(required=True, metavar="STEP")

    generated = steps.add_parser("generate", help="draw drives, write their logs, seal the truth")
    generated.add_argument("--drives", type=int, default=600)
    generated.add_argument("--seed", type=int, default=1)
    generated.add_argument(
        "--minutes", type=float, default=75.0, help="mean length of a drive; lengths vary by a tenth"
    )
    generated.add_argument(
        "--hilly", type=float, default=0.0, help="share of drives in hills, with the grade in the configuration"
    )
    generated.add_argument("--only", choices=list(draw.MIX), help="drives of one kind")
    generated.set_defaults(run=_generate)

    diagnosed = steps.add_parser("diagnose", help="diagnose every log with `roadload diagnose`")
    diagnosed.set_defaults(run=_diagnose)

    scored = steps.add_parser("score", help="check the seal and score the answers")
    scored.add_argument("--json", action="store_true")
    scored.add_argument("--markdown", type=Path, metavar="FILE.md", help="the same tables as a page")
    scored.set_defaults(run=_score)

    compared = steps.add_parser("peers", help="published methods on the same drives")
    compared.add_argument("--json", action="store_true")
    compared.set_defaults(run=_peers)

    for step in (generated, diagnosed, scored, compared):
        step.add_argument("folder", type=Path, metavar="OUT")
        step.add_argument("--workers", type=int, default=2)
    return parser


def _generate(options: argparse.Namespace) -> int:
    plans = draw.draw(options.drives, options.seed, options.minutes, options.hilly, options.only)
    made = world.make_all(plans, options.seed, options.folder, options.workers)
    for _ in track(made, "driving", total=len(plans), console=Console(stderr=True), transient=True):
        pass
    return 0


def _diagnose(options: argparse.Namespace) -> int:
    runs = diagnose.diagnose_all(options.folder, options.workers)
    total = len(seal.drives(options.folder))
    failed = 0
    for run in track(runs, "diagnosing", total=total, console=Console(stderr=True), transient=True):
        if run.answer is None:
            failed += 1
            print(f"{run.drive}: {run.error}", file=sys.stderr)
    return 1 if failed else 0


def _score(options: argparse.Namespace) -> int:
    cases = score.pair(seal.unseal(options.folder), diagnose.answers(options.folder))
    result = score.score(cases)
    if options.json:
        print(json.dumps(tables.as_json(result), indent=2))
    else:
        tables.show(result, Console())
    if options.markdown:
        options.markdown.write_text(tables.as_markdown(result))
    return 0


def _peers(options: argparse.Namespace) -> int:
    try:
        peers = importlib.import_module("blind.peers")
    except ImportError as error:
        print(f"error: {error.name} is missing; install tools/blind_peers.txt", file=sys.stderr)
        return 2
    figures = peers.compare(seal.unseal(options.folder), options.folder, options.workers)
    if options.json:
        print(json.dumps(peers.as_json(figures), indent=2))
    else:
        Console().print(peers.table(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
