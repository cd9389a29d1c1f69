"""Figures 3 to 6 on the dummy vehicle: error by coverage, noise and duration.

The posterior is sampled with the program's independence kernel: the same posterior as the random walk's, faster.
"""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import Availability, Drive, estimate
from paper.experiments import NOISE, PAPER_RULE, PROGRAM_RULE
from paper.vehicles import DUMMY, HP

PARTS = 60  # random stretches of each cycle, for coverage against error
MIN_STRETCH = 60  # s
MIN_SAMPLES = 20  # samples that a stretch must keep
NOISE_LEVELS = np.array([0.5, 1, 2, 5, 10, 20, 40]) * HP  # W
NOISE_REPEATS = 40
DURATIONS = 6  # from MIN_STRETCH to the whole cycle
COPIES = (2, 4, 8)  # of the whole cycle, beyond that
DURATION_REPEATS = 30


def _errors(kept: Drive, seed: tuple[int, ...]) -> Floats:
    errors: Floats = estimate(kept, seed, "independence").mean / DUMMY - 1
    return errors


@dataclass(frozen=True)
class CoverageStudy:
    """``coverage`` (n,) and ``errors`` (n, 3) of [A, C, m] of random stretches of a cycle."""

    coverage: Floats
    errors: Floats


def coverage_and_error(cycle: Cycle, reach: Availability, seed: int) -> CoverageStudy:
    """Estimate from PARTS random stretches of ``cycle``, of lengths between MIN_STRETCH and all of it."""
    rng = np.random.default_rng((6, seed))
    looped = cycle.repeated(2)
    coverage: list[float] = []
    errors: list[Floats] = []
    while len(coverage) < PARTS:
        length = round(np.exp(rng.uniform(np.log(MIN_STRETCH), np.log(cycle.duration))))
        start = int(rng.integers(cycle.duration))
        kept = Drive.of(looped[start : start + length], DUMMY, NOISE, (7, seed, start, length)).positive()
        if len(kept.P) >= MIN_SAMPLES:
            coverage.append(reach.coverage(kept))
            errors.append(_errors(kept, (8, seed, start, length)))
    return CoverageStudy(np.array(coverage), np.array(errors))


@dataclass(frozen=True)
class NoiseStudy:
    """``errors`` (levels, repeats, 3) of [A, C, m], and the ``residual`` rms [W] and ``chi2`` [W^2] (levels,)."""

    errors: Floats
    residual: Floats
    chi2: Floats

    @property
    def rms_errors(self) -> Floats:
        """Rms (levels, 3) over the repeats."""
        rms: Floats = np.sqrt((self.errors**2).mean(axis=1))
        return rms


def noise_and_error(cycle: Cycle) -> dict[str, NoiseStudy]:
    """Estimate at each of NOISE_LEVELS, for the paper's choice of samples and the program's."""
    errors: dict[str, list[list[Floats]]] = {PAPER_RULE: [], PROGRAM_RULE: []}
    variance: dict[str, list[float]] = {PAPER_RULE: [], PROGRAM_RULE: []}
    sums: dict[str, list[float]] = {PAPER_RULE: [], PROGRAM_RULE: []}
    for level in NOISE_LEVELS:
        drives = [Drive.of(cycle, DUMMY, level, (9, i)) for i in range(NOISE_REPEATS)]
        for rule, kept in (
            (PAPER_RULE, [drive.positive() for drive in drives]),
            (PROGRAM_RULE, [drive.above_noise() for drive in drives]),
        ):
            variances = [k.target().variance for k in kept]
            errors[rule].append([_errors(k, (10, i)) for i, k in enumerate(kept)])
            variance[rule].append(float(np.mean(variances)))
            sums[rule].append(float(np.mean([v * (len(k.P) - 3) for v, k in zip(variances, kept, strict=True)])))
    return {rule: NoiseStudy(np.array(errors[rule]), np.sqrt(variance[rule]), np.array(sums[rule])) for rule in errors}


@dataclass(frozen=True)
class DurationStudy:
    """Rms errors (n, 3) of [A, C, m] over DURATION_REPEATS noises after ``seconds`` (n,); the last are copies."""

    seconds: Floats
    errors: Floats

    @property
    def whole(self) -> int:
        """Index of the whole cycle, once."""
        return DURATIONS - 1


def duration_and_error(cycle: Cycle) -> DurationStudy:
    """Estimate from the first seconds of a cycle, from all of it, and from COPIES of it with fresh noise."""
    lengths = np.geomspace(MIN_STRETCH, cycle.duration, DURATIONS).round()
    pieces = [cycle[: int(s)] for s in lengths] + [cycle.repeated(n) for n in COPIES]
    errors = []
    for piece in pieces:
        kept = [Drive.of(piece, DUMMY, NOISE, (11, i)).positive() for i in range(DURATION_REPEATS)]
        errors.append(np.sqrt(np.mean([_errors(k, (12, i)) ** 2 for i, k in enumerate(kept)], axis=0)))
    return DurationStudy(np.array([piece.duration for piece in pieces], dtype=float), np.array(errors))
