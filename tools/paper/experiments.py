"""Tables 1 to 4, Levene's test and Figure 1 on simulated runs, from fixed seeds."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, levene

from estimator.sampling.identifiability import EigenMetrics
from estimator.sampling.metropolis import REFRESH
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import BURN_IN, Drive, Estimate, estimate, scaled_metrics, scheduled_walk
from paper.printed import PRINTED
from paper.table_five import printed_information
from paper.vehicles import DUMMY, HP, NOMINAL, TO_SI

NOISE = 5 * HP  # W, sd of the power noise where nothing else is said: the level of Figure 6
SELECTION_FITS = 200
PAPER_RULE, PROGRAM_RULE = "P > 0", "model power > 3 sd"  # which samples are kept
SCHEDULES = {"from the start": REFRESH, "at iteration 5000": BURN_IN, "at iteration 5100": BURN_IN + REFRESH}
SCHEDULE_NOISES = (1 * HP, 5 * HP)  # W
SCHEDULE_SEEDS = 5


def truth_of(cycle: str) -> Floats:
    """Parameters (3,) in SI of the simulated truck: the printed mean over the runs of ``cycle``."""
    truth: Floats = PRINTED[cycle].estimates.mean(axis=0) * TO_SI
    return truth


def simulated_run(cycle: Cycle, index: int) -> Drive:
    """Run ``index`` of a cycle with white power noise of the rms that is printed for that run."""
    return Drive.of(cycle, truth_of(cycle.name), PRINTED[cycle.name].rms[index] * HP, (1, index))


def run_estimate(cycle: Cycle, index: int) -> Estimate:
    """Estimate of run ``index`` from the samples that the paper keeps."""
    return estimate(simulated_run(cycle, index).positive(), (2, index))


def runs(cycle: Cycle) -> list[Estimate]:
    """Estimates of as many runs as the paper prints for ``cycle``."""
    return [run_estimate(cycle, index) for index in range(len(PRINTED[cycle.name].rms))]


def means(estimates: list[Estimate]) -> Floats:
    """Posterior means (n, 3) in the paper's units."""
    converted: Floats = np.array([estimate.mean for estimate in estimates]) / TO_SI
    return converted


@dataclass(frozen=True)
class DummyCase:
    """Kept mean and sd (3,) of the noiseless dummy case under two schedules."""

    cycle: str
    refreshed: tuple[Floats, Floats]
    frozen: tuple[Floats, Floats]


def dummy_case(cycle: Cycle) -> DummyCase:
    """Sample the dummy vehicle's posterior from power without noise."""
    kept = Drive.of(cycle, DUMMY).positive()
    walks = [scheduled_walk(kept, first)[:, BURN_IN:].reshape(-1, 3) for first in (REFRESH, BURN_IN)]
    refreshed, frozen = ((w.mean(axis=0), w.std(axis=0, ddof=1)) for w in walks)
    return DummyCase(cycle.name, refreshed, frozen)


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """Sd between runs of one cycle beside what white noise gives; all (3,) in the paper's units.

    ``printed``: over the printed runs. ``white``: from the printed Table 5 and the printed rms. ``posterior`` and
    ``simulated``: mean sd of the posterior and sd between runs, of simulated runs. ``p`` (3,): probability of at
    least the printed scatter if ``white`` were its sd.
    """

    printed: Floats
    white: Floats
    posterior: Floats
    simulated: Floats
    p: Floats


def white_noise_covariance(cycle: str) -> Floats:
    """Covariances (n, 3, 3) of the printed runs for white power noise of the printed rms, in the paper's units."""
    printed = PRINTED[cycle]
    return np.linalg.inv(printed_information(printed)) * (550 * printed.rms[:, None, None]) ** 2


def scatter(cycle: str, simulated: list[Estimate]) -> Scatter:
    """Compare the scatter of the printed runs of ``cycle`` with that of white noise."""
    printed = PRINTED[cycle].estimates
    white = np.sqrt(np.diagonal(white_noise_covariance(cycle).mean(axis=0)))
    sd = printed.std(axis=0, ddof=1)
    degrees = len(printed) - 1
    return Scatter(
        printed=sd,
        white=white,
        posterior=np.mean([run.sd for run in simulated], axis=0) / TO_SI,
        simulated=means(simulated).std(axis=0, ddof=1),
        p=chi2.sf(degrees * (sd / white) ** 2, degrees),
    )


def selection_bias(cycle: Cycle) -> dict[str, Floats]:
    """Mean error (3,) of SELECTION_FITS least-squares fits, for the paper's choice of samples and the program's."""
    truth = truth_of(cycle.name)
    drives = [Drive.of(cycle, truth, NOISE, (1, i)) for i in range(SELECTION_FITS)]
    chosen = {PAPER_RULE: [d.positive() for d in drives], PROGRAM_RULE: [d.above_noise() for d in drives]}
    return {rule: np.mean([k.target().centre / truth - 1 for k in kept], axis=0) for rule, kept in chosen.items()}


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


def levene_tests(estimates: dict[str, Floats]) -> list[Levene]:
    """Test each of A, C, m for equal variance between cycles; ``estimates`` (n, 3) by cycle."""
    return [Levene.of([values[:, i] for values in estimates.values()]) for i in range(3)]


@dataclass(frozen=True)
class TraceFit:
    """Rms [W] of measured power minus model power over the kept samples of a run: best fit, and nominal parameters."""

    best: float
    nominal: float

    @classmethod
    def of(cls, kept: Drive, best: Floats) -> "TraceFit":
        """Residuals of ``kept`` with the parameters ``best`` (3,) and with the nominal ones."""
        powers = [Drive.of(Cycle("", kept.v, kept.a), theta).P for theta in (best, NOMINAL)]
        return cls(*(float(np.sqrt(np.mean((kept.P - P) ** 2))) for P in powers))


@dataclass(frozen=True)
class ScheduleEffect:
    """Kept sd of the mass over that with sigma fixed: median and largest over SCHEDULE_SEEDS noises."""

    noise: float
    schedule: str
    median: float
    largest: float


def schedule_effects(cycle: Cycle) -> list[ScheduleEffect]:
    """How much the frozen start of the paper's schedule widens the kept draws."""
    effects = []
    for noise in SCHEDULE_NOISES:
        drives = [Drive.of(cycle, DUMMY, noise, (3, i)).positive() for i in range(SCHEDULE_SEEDS)]
        reference = [estimate(kept, (4, i)).sd[2] for i, kept in enumerate(drives)]
        for schedule, first in SCHEDULES.items():
            walks = [scheduled_walk(kept, first, (5, i))[:, BURN_IN:, 2] for i, kept in enumerate(drives)]
            ratio = [float(walk.std(ddof=1) / sd) for walk, sd in zip(walks, reference, strict=True)]
            effects.append(ScheduleEffect(noise, schedule, float(np.median(ratio)), max(ratio)))
    return effects


def scaled_eigen_metrics(cycles: dict[str, Cycle], all_runs: dict[str, list[Estimate]]) -> dict[str, EigenMetrics]:
    """Eigen-metrics of the first run of every cycle, with parameters in units of their posterior sd."""
    return {name: scaled_metrics(simulated_run(c, 0).positive(), all_runs[name][0]) for name, c in cycles.items()}
