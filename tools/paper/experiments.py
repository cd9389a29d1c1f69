"""Tables 1 to 4, Levene's test and Figure 1 on simulated runs, from fixed seeds."""

import numpy as np
from harness.scores import rms
from scipy.stats import chi2, levene

from estimator.model.road_load import power
from estimator.sampling.metropolis import REFRESH
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import BURN_IN, Drive, Estimate, estimate, scheduled_walk
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


def dummy_case(cycle: Cycle) -> list[tuple[Floats, Floats]]:
    """Kept mean and sd (3,) from power without noise, with sigma refreshed from the start and frozen at first."""
    kept = Drive.of(cycle, DUMMY).positive()
    walks = [scheduled_walk(kept, first)[:, BURN_IN:].reshape(-1, 3) for first in (REFRESH, BURN_IN)]
    return [(w.mean(axis=0), w.std(axis=0, ddof=1)) for w in walks]


def white_noise_covariance(cycle: str) -> Floats:
    """Covariances (n, 3, 3) of the printed runs for white power noise of the printed rms, in the paper's units."""
    printed = PRINTED[cycle]
    return np.linalg.inv(printed_information(printed)) * (550 * printed.rms[:, None, None]) ** 2


def scatter(cycle: str, simulated: list[Estimate]) -> dict[str, Floats]:
    """Sd between the runs of ``cycle`` beside what white noise gives; all (3,) in the paper's units.

    "p" is the probability of at least the printed scatter if that of white noise were its sd.
    """
    printed = PRINTED[cycle].estimates
    white = np.sqrt(np.diagonal(white_noise_covariance(cycle).mean(axis=0)))
    sd = printed.std(axis=0, ddof=1)
    degrees = len(printed) - 1
    return {
        "printed runs, sd": sd,
        "white noise of the printed rms, by Table 5": white,
        "simulated runs, mean posterior sd": np.mean([run.sd for run in simulated], axis=0) / TO_SI,
        "simulated runs, sd": means(simulated).std(axis=0, ddof=1),
        "p of the printed sd, if white noise": chi2.sf(degrees * (sd / white) ** 2, degrees),
    }


def selection_bias(cycle: Cycle) -> dict[str, Floats]:
    """Mean error (3,) of SELECTION_FITS least-squares fits, for the paper's choice of samples and the program's."""
    truth = truth_of(cycle.name)
    drives = [Drive.of(cycle, truth, NOISE, (1, i)) for i in range(SELECTION_FITS)]
    chosen = {PAPER_RULE: [d.positive() for d in drives], PROGRAM_RULE: [d.above_noise() for d in drives]}
    return {rule: np.mean([k.target().centre / truth - 1 for k in kept], axis=0) for rule, kept in chosen.items()}


def levene_tests(estimates: dict[str, Floats]) -> list[tuple[float, float]]:
    """Levene's statistic and its p-value for each of A, C, m between cycles; ``estimates`` (n, 3) by cycle."""
    tests = [levene(*(values[:, i] for values in estimates.values())) for i in range(3)]
    return [(float(test.statistic), float(test.pvalue)) for test in tests]


def residuals(kept: Drive, best: Floats) -> dict[str, float]:
    """Figure 2: rms [hp] of measured power minus model power of a run, with ``best`` (3,) and nominal parameters."""
    powers = {"best fit": best, "nominal": NOMINAL}
    return {f"{name} [hp]": rms(kept.P - power(kept.v, kept.a, theta)) / HP for name, theta in powers.items()}


def schedule_effects(cycle: Cycle) -> list[dict[str, float | str]]:
    """Figure 1: kept sd of the mass over that with sigma fixed, by the first refresh of the paper's schedule.

    The median and the largest are over SCHEDULE_SEEDS noises.
    """
    effects: list[dict[str, float | str]] = []
    for noise in SCHEDULE_NOISES:
        drives = [Drive.of(cycle, DUMMY, noise, (3, i)).positive() for i in range(SCHEDULE_SEEDS)]
        reference = [estimate(kept, (4, i)).sd[2] for i, kept in enumerate(drives)]
        for schedule, first in SCHEDULES.items():
            walks = [scheduled_walk(kept, first, (5, i))[:, BURN_IN:, 2] for i, kept in enumerate(drives)]
            ratio = [float(walk.std(ddof=1) / sd) for walk, sd in zip(walks, reference, strict=True)]
            which: dict[str, float | str] = {"noise [hp]": noise / HP, "first refresh": schedule}
            effects.append(which | {"median ratio": float(np.median(ratio)), "largest": max(ratio)})
    return effects
