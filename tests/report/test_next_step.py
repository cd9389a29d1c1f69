"""The advice beside a status fits the reason for it."""

from collections import Counter

import pytest

from estimator.config import from_dict
from estimator.estimates import Coverage, Estimate, Status
from estimator.report.next_step import next_step
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.replay import Run

WIDE, NARROW, UNKNOWN = Coverage(40, 100), Coverage(9, 100), Coverage(0, 0)


def run(
    status: Status,
    admitted: int,
    coverage: Coverage,
    remedy: str | None = None,
) -> Run:
    pipeline = Pipeline(from_dict({}))
    update = Estimate(
        t=0.0,
        status=status,
        reason="a reason",
        coverage=coverage,
        admitted=admitted,
        remedy=remedy,
    )
    return Run(pipeline=pipeline, updates=[update], skipped=Counter(), mixed_channels=Counter())


@pytest.mark.parametrize(
    ("case", "advice"),
    [
        (run(Status.ESTIMATED, 5000, WIDE), ""),
        (run(Status.UNESTIMATED, 599, WIDE), "it takes 1 min of pulling"),
        (run(Status.UNESTIMATED, 5000, UNKNOWN), "the boxes of [prior]"),
        (run(Status.UNESTIMATED, 5000, NARROW), "with more speeds and accelerations"),
        (run(Status.UNESTIMATED, 5000, WIDE), "`roadload diagnose` with the same logs"),
        (run(Status.INVALID, 5000, WIDE), "`roadload diagnose` with the same logs"),
        (run(Status.UNESTIMATED, 5000, UNKNOWN, remedy="leave it out"), "leave it out"),
        (run(Status.UNESTIMATED, 5000, UNKNOWN, remedy=""), ""),
    ],
)
def test_the_advice_fits(case: Run, advice: str) -> None:
    assert advice in next_step(case)
    assert bool(next_step(case)) == bool(advice)
