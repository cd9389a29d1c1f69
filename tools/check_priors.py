"""How well the prior odds of the diagnosis suit drives whose truth is known, and which odds would suit them best.

    python tools/check_priors.py out/blind [out/other ...]

Folders are those of `check_blind.py`, generated and diagnosed. With the odds of all effects and processes times a
factor r, the probability p that nothing acts on a drive becomes p / (p + r (1 - p)). That is so for sets of one cause;
drives with two effects are left out. An effect that the oracle does not see counts as nothing. The score is the sum of
the logarithms of the probability that each answer gives to the truth, "nothing" or "something" (Good 1952). The odds
are `ODDS_OF_EFFECTS` and `ODDS_OF_PROCESSES` in `estimator/components/hypothesis_space.py`. A folder whose drives are
all clean says nothing of them: how often something acts is part of the odds.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from blind import answer, diagnose, score, seal
from blind.case import Case
from blind.quality import nothing_acts
from harness.check import Cells, Check, Figures, Table
from scipy.optimize import minimize_scalar

from estimator.errors import InputError
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


def measure(options: argparse.Namespace) -> Figures:
    """The score by factor, and the best one."""
    cases = [case for folder in options.folders for case in score.pair(seal.unseal(folder), diagnose.answers(folder))]
    none, is_none = answers(cases)
    if is_none.all() or not is_none.any():
        raise InputError("drives on which something acts and on which nothing does are needed")
    best, rows = best_factor(none, is_none), []
    for factor in sorted({*FACTORS, best}):
        p = with_factor(none, factor)
        means = {"nothing acts": float(p[is_none].mean()), "something does": float(p[~is_none].mean())}
        rows.append({"prior odds times": factor, "score": log_score(none, is_none, factor), **means})
    return {"drives": len(none), "on_which_nothing_acts": int(is_none.sum()), "best_factor": best, "factors": rows}


def tables(figures: Figures) -> list[Table]:
    """A row for each factor."""
    of = f"{figures['drives']} drives, on {figures['on_which_nothing_acts']} of them nothing"
    return [Table.of(f"{of}; mean P(nothing) where", figures["factors"])]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the folders."""
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT")


CHECK = Check(
    title="Prior odds of the diagnosis",
    first="out/blind",
    measure=measure,
    tables=tables,
    headline=Cells(rows=()),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
