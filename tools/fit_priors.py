"""How well the prior odds of the diagnosis suit drives whose truth is known, and which odds would suit them best.

    python tools/fit_priors.py out/blind [out/other ...]

Folders are those of `blind_check.py`, generated and diagnosed. With the odds of all effects and processes times a
factor r, the probability p that nothing acts on a drive becomes p / (p + r (1 - p)), as for sets of one cause: drives
with two effects are left out. An effect that the oracle does not see counts as nothing. The score is the sum of the
logarithms of the probability that each answer gives to the truth, "nothing" or "something" (Good 1952). The odds are
`ODDS_OF_EFFECTS` and `ODDS_OF_PROCESSES` in `estimator/components/hypotheses.py`. A folder whose drives are all clean
says nothing of them: how often something acts is part of the odds.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from blind import answer, diagnose, score, seal
from blind.case import Case
from blind.quality import nothing_acts
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize_scalar

from estimator.errors import RoadloadError
from estimator.signals import Floats, Mask

FACTORS = (0.1, 0.3, 0.5, 1.0, 2.0, 3.0, 10.0)
RANGE = 1e-3, 1e3  # of the factors that the best one is looked for in
LEAST = 1e-9  # probability: a certain answer that is wrong costs 21


def with_factor(none: Floats, factor: float) -> Floats:
    """Probability (n,) that nothing acts where prior odds are ``factor`` times those of ``none`` (n,)."""
    found: Floats = np.clip(none / (none + factor * (1 - none)), LEAST, 1 - LEAST)
    return found


def log_score(none: Floats, is_none: Mask, factor: float) -> float:
    """Sum of the logarithms of the probability that each answer gives to the truth."""
    changed = with_factor(none, factor)
    return float(np.log(np.where(is_none, changed, 1 - changed)).sum())


def best_factor(none: Floats, is_none: Mask) -> float:
    """The factor with the largest score."""
    low, high = np.log(RANGE)
    found = minimize_scalar(lambda x: -log_score(none, is_none, float(np.exp(x))), bounds=(low, high), method="bounded")
    return float(np.exp(found.x))


def answers(cases: Sequence[Case]) -> tuple[Floats, Mask]:
    """The probability (n,) that nothing acts by each answer, and whether nothing does (n,)."""
    found = [
        (1 - sum(finding.probability or 0.0 for finding in case.run.answer.candidates), nothing_acts(case))
        for case in cases
        if case.truth.kind != "pair" and answer.credible_set(case.run) is not None and case.run.answer is not None
    ]
    return np.clip([p for p, _ in found], LEAST, 1.0), np.array([is_none for _, is_none in found], dtype=np.bool_)


def main() -> int:
    """Print the score by factor and the best one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT")
    options = parser.parse_args()
    try:
        cases = [
            case for folder in options.folders for case in score.pair(seal.unseal(folder), diagnose.answers(folder))
        ]
    except (seal.SealError, RoadloadError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    none, is_none = answers(cases)
    if is_none.all() or not is_none.any():
        print("error: drives on which something acts and on which nothing does are needed", file=sys.stderr)
        return 2
    best = best_factor(none, is_none)
    table = Table("prior odds times", "score", "mean P(nothing) where nothing acts", "where something does")
    for factor in sorted({*FACTORS, best}):
        p = with_factor(none, factor)
        means = f"{p[is_none].mean():.3f}", f"{p[~is_none].mean():.3f}"
        table.add_row(f"{factor:.2g}", f"{log_score(none, is_none, factor):.2f}", *means)
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(table)
    console.print(f"{len(none)} drives, on {is_none.sum()} of them nothing; best factor {best:.2g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
