"""What the paper computed, one function a table or figure; seeds are fixed, so a second run gives the same numbers."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import levene

from estimator.sampling.identifiability import EigenMetrics
from estimator.sampling.metropolis import REFRESH
from estimator.signals import Floats
from paper.cycles import Cycle, commut, hhddt, hwfet
from paper.estimation import (
    BURN_IN,
    Availability,
    Drive,
    Estimate,
    estimate,
    raw_metrics,
    scaled_metrics,
    scheduled_walk,
)
from paper.vehicles import DUMMY, DYNO, LBF, MPH, SLUG

NOISE = 5e3  # W, sd of the power noise where nothing else is said: about 1 % of the highest power
RUNS = 12  # repetitions of each cycle
SELECTION_FITS = 200
PAPER_RULE, PROGRAM_RULE = "P > 0", "model power > 3 sd"  # which samples are kept
SCHEDULES = {"from the start": REFRESH, "at iteration 5000": BURN_IN, "at iteration 5100": BURN_IN + REFRESH}
SCHEDULE_NOISES = (1e3, 5e3)  # W
SCHEDULE_SEEDS = 5
PARTS = 60  # of the joined cycles, for coverage against error
SHORTEST = 60  # s
FEWEST = 20  # samples that a stretch must keep
NOISE_LEVELS = np.array([0.5e3, 1e3, 2e3, 5e3, 10e3, 20e3, 40e3])  # W
NOISE_REPEATS = 6
DURATIONS = 7
DURATION_REPEATS = 4
COMMON_MASS = DYNO * [1.0, 1.0, LBF / MPH / SLUG]  # 1863 taken as lbf/(mph/s), what needs no constant in mph


@dataclass(frozen=True)
class DummyCase:
    """Kept mean and sd (3,) of the noiseless dummy case under two schedules."""

    cycle: str
    refreshed: tuple[Floats, Floats]
    frozen: tuple[Floats, Floats]


def cycles_at_hand() -> list[Cycle]:
    """HWFET and COMMUT, and HHDDT where its tables are."""
    return [cycle for cycle in (hwfet(), commut(), hhddt()) if cycle is not None]


def dummy_case(cycle: Cycle) -> DummyCase:
    """Sample the dummy vehicle's posterior from power without noise."""
    kept = Drive.of(cycle, DUMMY).positive()
    walks = [scheduled_walk(kept, first)[:, BURN_IN:].reshape(-1, 3) for first in (REFRESH, BURN_IN)]
    refreshed, frozen = ((w.mean(axis=0), w.std(axis=0, ddof=1)) for w in walks)
    return DummyCase(cycle.name, refreshed, frozen)


def runs(cycle: Cycle) -> list[Estimate]:
    """Estimates of the dynamometer truck from RUNS noisy repetitions of a cycle."""
    return [estimate(Drive.of(cycle, DYNO, NOISE, (1, run)).positive(), (2, run)) for run in range(RUNS)]


def selection_bias(cycle: Cycle) -> dict[str, Floats]:
    """Mean error (3,) of SELECTION_FITS least-squares fits, for the paper's choice of samples and the program's."""
    drives = [Drive.of(cycle, DYNO, NOISE, (1, i)) for i in range(SELECTION_FITS)]
    chosen = {PAPER_RULE: [d.positive() for d in drives], PROGRAM_RULE: [d.above_noise() for d in drives]}
    return {rule: np.mean([k.target().centre / DYNO - 1 for k in kept], axis=0) for rule, kept in chosen.items()}


@dataclass(frozen=True)
class Levene:
    """Levene's statistic and its p-value."""

    statistic: float
    p: float

    @classmethod
    def of(cls, groups: list[Floats]) -> "Levene":
        """Test that all groups have the same variance (deviations from the median)."""
        result = levene(*groups)
        return cls(float(result.statistic), float(result.pvalue))


def levene_of_estimates(all_runs: dict[str, list[Estimate]]) -> list[Levene]:
    """Does the scatter of the estimates between runs differ between cycles: one test each for A, C, m."""
    means = [np.array([run.mean for run in repeated]) for repeated in all_runs.values()]
    return [Levene.of([m[:, i] for m in means]) for i in range(3)]


def levene_of_residuals(cycles: list[Cycle], all_runs: dict[str, list[Estimate]]) -> Levene:
    """Does the power residual of the first run differ between cycles; its true sd is the same in all."""
    residuals = []
    for cycle in cycles:
        kept = Drive.of(cycle, DYNO, NOISE, (1, 0)).positive()
        residuals.append(kept.P - Drive.of(Cycle(cycle.name, kept.v, kept.a), all_runs[cycle.name][0].mean).P)
    return Levene.of(residuals)


@dataclass(frozen=True)
class ScheduleEffect:
    """Kept sd of the mass over that with sigma fixed: median and largest over SCHEDULE_SEEDS noises."""

    noise: float
    schedule: str
    median: float
    largest: float


def schedule_effects(cycle: Cycle) -> list[ScheduleEffect]:
    """How much the frozen start of the paper's schedule widens what is kept."""
    effects = []
    for noise in SCHEDULE_NOISES:
        drives = [Drive.of(cycle, DYNO, noise, (3, i)).positive() for i in range(SCHEDULE_SEEDS)]
        reference = [estimate(kept, (4, i)).sd[2] for i, kept in enumerate(drives)]
        for schedule, first in SCHEDULES.items():
            walks = [scheduled_walk(kept, first, (5, i))[:, BURN_IN:, 2] for i, kept in enumerate(drives)]
            ratio = [float(walk.std(ddof=1) / sd) for walk, sd in zip(walks, reference, strict=True)]
            effects.append(ScheduleEffect(noise, schedule, float(np.median(ratio)), max(ratio)))
    return effects


@dataclass(frozen=True)
class TableFive:
    """Raw eigen-metrics for two readings of the mass unit, by cycle, and those scaled by the posterior."""

    slug: dict[str, EigenMetrics]
    common: dict[str, EigenMetrics]
    scaled: dict[str, EigenMetrics]


def table_five(cycles: list[Cycle], all_runs: dict[str, list[Estimate]]) -> TableFive:
    """Eigen-metrics of every cycle."""
    drives = {c.name: Drive.of(c, DYNO, NOISE, (1, 0)).positive() for c in cycles}
    return TableFive(
        {c.name: raw_metrics(c, DYNO) for c in cycles},
        {c.name: raw_metrics(c, COMMON_MASS) for c in cycles},
        {name: scaled_metrics(kept, all_runs[name][0]) for name, kept in drives.items()},
    )


def _errors(kept: Drive, seed: tuple[int, ...]) -> Floats:
    return estimate(kept, seed).mean / DUMMY - 1


def coverage_and_error(cycle: Cycle) -> tuple[Floats, Floats]:
    """Coverage (PARTS,) and error of [A, C, m] (PARTS, 3) from random stretches of the joined cycles."""
    rng = np.random.default_rng(6)
    reach = Availability.of(cycle, DUMMY)
    looped = Cycle(cycle.name, np.tile(cycle.v, 2), np.tile(cycle.a, 2))
    coverage, errors = [], []
    while len(coverage) < PARTS:
        length = round(np.exp(rng.uniform(np.log(SHORTEST), np.log(cycle.duration))))
        start = int(rng.integers(cycle.duration))
        kept = Drive.of(looped[start : start + length], DUMMY, NOISE, (7, start, length)).positive()
        if len(kept.P) >= FEWEST:
            coverage.append(reach.coverage(kept))
            errors.append(_errors(kept, (8, start, length)))
    return np.array(coverage), np.array(errors)


def noise_and_error(cycle: Cycle) -> dict[str, Floats]:
    """Error (levels, repeats, 3) by power noise, for the paper's choice of samples and the program's."""
    errors: dict[str, list[list[Floats]]] = {PAPER_RULE: [], PROGRAM_RULE: []}
    for level in NOISE_LEVELS:
        drives = [Drive.of(cycle, DUMMY, level, (9, i)) for i in range(NOISE_REPEATS)]
        errors[PAPER_RULE].append([_errors(drive.positive(), (10, i)) for i, drive in enumerate(drives)])
        errors[PROGRAM_RULE].append([_errors(drive.above_noise(), (10, i)) for i, drive in enumerate(drives)])
    return {rule: np.array(e) for rule, e in errors.items()}


def duration_and_error(cycle: Cycle) -> tuple[Floats, Floats]:
    """Seconds from the start of a cycle (DURATIONS,) and median absolute error of [A, C, m] (DURATIONS, 3)."""
    seconds = np.geomspace(SHORTEST, cycle.duration, DURATIONS).round()
    errors = [
        np.median(
            [
                np.abs(_errors(Drive.of(cycle[: int(s)], DUMMY, NOISE, (11, i)).positive(), (12, i)))
                for i in range(DURATION_REPEATS)
            ],
            axis=0,
        )
        for s in seconds
    ]
    return seconds, np.array(errors)
