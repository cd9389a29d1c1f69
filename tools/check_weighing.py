"""Dynamic on-board weighing: when each load is known first, and how regularly after that, over a hidden road.

    python tools/check_weighing.py [--drives 10] [--minutes 40] [--seed 1]

Three loads on three kinds of road, no signal of the road on the bus, J1939 bytes, the streaming estimator. A value is
fresh when it was computed just now and its 90 % interval is within 5 % of its mean. A drive conforms when the first
fresh value comes within 15 minutes of moving off, and no later one more than 10 minutes after the one before. The end
of the drive counts as one.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product

import numpy as np
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import SLOPES, drive, estimates, loaded, showing, traffic
from harness.scores import Score, summary

from estimator.config import Config
from estimator.estimates import Marginal
from estimator.simulation.route import RoadKind
from estimator.simulation.truck import draw_truck

PERMISSIBLE_MASS = 40e3  # kg, of a combination of five axles in the EU
LOADS = {"45-55 %": (0.45, 0.55), "65-75 %": (0.65, 0.75), "90-100 %": (0.9, 1.0)}  # of the permissible mass
ROADS: dict[str, tuple[RoadKind, tuple[float, float]]] = {  # kind, sd of the slopes [1]
    "urban, level": ("urban", (0.0, 0.0)),
    "regional, hills": ("mixed", SLOPES),
    "highway, hills": ("highway", SLOPES),
}
HALF_WIDTH = 0.05  # of the mean, of the 90 % interval of a fresh value
FIRST, AGAIN = 15 * 60.0, 10 * 60.0  # s, latest times of the first fresh value and of each next one


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """One drive, times from moving off [s]: fresh values at ``t`` (n,) with their ``scores`` (n,), and the ``end``."""

    road: str
    load: str
    t: list[float]
    scores: list[Score]
    end: float

    @property
    def longest_wait(self) -> float:
        """Longest time [s] from one fresh value to the next, or to the end of the drive; infinite without any."""
        return float(np.diff([*self.t, self.end]).max()) if self.t else np.inf

    @property
    def conforms(self) -> bool:
        """Whether all values came in time."""
        return bool(self.t) and self.t[0] <= FIRST and self.longest_wait <= AGAIN


def is_fresh(mass: Marginal | None) -> bool:
    """Whether the interval of a mass is narrow enough."""
    return mass is not None and max(mass.q95 - mass.mean, mass.mean - mass.q05) <= HALF_WIDTH * mass.mean


def weigh(road: str, load: str, minutes: float, rng: np.random.Generator) -> Weighed:
    """Drive with a load drawn from ``load`` over a road drawn from ``road``, and estimate while driving."""
    kind, slopes = ROADS[road]
    drawn = draw_truck(rng)
    mass = PERMISSIBLE_MASS * rng.uniform(*LOADS[load])
    recording = drive(loaded(drawn, mass), kind, minutes, rng, rng.uniform(*slopes), showing())
    frames = traffic(recording)
    updates = estimates(frames, Config())
    moving = recording.truth.t[recording.truth.v > 0]
    off = float(frames.t[0] + moving[0])
    fresh = [(update.t - off, update.mass) for update in updates if update.mass is not None and is_fresh(update.mass)]
    return Weighed(
        road=road,
        load=load,
        t=[t for t, _ in fresh],
        scores=[Score.of(found, mass) for _, found in fresh],
        end=float(moving[-1] - moving[0]),
    )


def figures_of(drives: Sequence[Weighed]) -> Figures:
    """Figures of some drives; times in minutes, and scores of the first and of the last fresh value."""
    weighed = [drive for drive in drives if drive.t]
    first = np.array([drive.t[0] for drive in weighed]) / 60
    return {
        "drives": len(drives),
        "weighed": len(weighed),
        "conform": sum(drive.conforms for drive in drives),
        "first_min": {"median": float(np.median(first)), "worst": float(first.max())} if weighed else None,
        "longest_wait_min": max(drive.longest_wait for drive in weighed) / 60 if weighed else None,
        "first": summary([drive.scores[0] for drive in weighed]),
        "last": summary([drive.scores[-1] for drive in weighed]),
    }


def row(figures: Figures) -> list[str]:
    """Figures as cells of the table."""
    if figures["first_min"] is None:
        return [f"0 of {figures['drives']}", *[""] * 5]
    scores = figures["first"], figures["last"]
    return [
        f"{figures['conform']} of {figures['drives']}",
        f"{figures['first_min']['median']:.1f}, {figures['first_min']['worst']:.1f}",
        f"{figures['longest_wait_min']:.1f}",
        *(f"{percent(x['rms'])}, {percent(x['worst'])}" for x in scores),
        f"{scores[0]['holds']}, {scores[1]['holds']} of {figures['weighed']}",
    ]


def measure(options: argparse.Namespace) -> Figures:
    """Figures of each road and load, and of all drives."""
    cells = list(product(ROADS, LOADS, range(options.drives)))
    drives = []
    for k, (road, load, _) in enumerate(progress(cells, "driving")):
        drives.append(weigh(road, load, options.minutes, np.random.default_rng([options.seed, k])))
    figures = [
        {"road": road, "load": load, **figures_of([x for x in drives if (x.road, x.load) == (road, load)])}
        for road, load in product(ROADS, LOADS)
    ]
    each = [asdict(x) | {"scores": [score.error for score in x.scores]} for x in drives]
    return {"cells": figures, "all": figures_of(drives), "drives": each}


def tables(figures: Figures) -> list[Table]:
    """A row for each road and load, and one for all."""
    values = ("conform", "first, median and worst [min]", "longest wait [min]")
    errors = ("first: rms, worst error", "last: rms, worst error", "interval holds: first, last")
    rows = [[cell["road"], cell["load"], *row(cell)] for cell in figures["cells"]]
    return [Table("", ("road", "load", *values, *errors), [*rows, ["all", "", *row(figures["all"])]])]


CHECK = Check(
    title="Weighing on the way",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("all",), columns=("conform", "first, median and worst [min]")),
    options=drive_options(drives=10, minutes=40.0),
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
