"""Coverage of the intervals and simulation-based calibration, on data whose truth is known exactly.

    python tools/calibration.py [--sets 300] [--json]

Speed and acceleration are those of simulated drives. For every data set a truth theta = [A, C, m] is drawn from a
box, power is P = A v + C v^3 + m v a plus noise of one of several kinds, and speed is measured with white noise and
the resolution of CCVS1. Rows, samples, fit and sampler are the project's own, with the masks of its admission. If the
posterior is right, a truth drawn from the prior is inside a 90 % interval in 90 % of the data sets, and its rank among
posterior draws is uniform (Talts, Betancourt, Simpson, Vehtari, Gelman 2018, arXiv 1804.06788).
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chisquare

from estimator.config import Config
from estimator.estimation import moments, posterior
from estimator.model.road_load import design
from estimator.preparation.sample_maker import SampleMaker
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Mask, Role
from estimator.simulation import drive as simulation
from estimator.simulation.moment import STEP as SIMULATED_STEP
from estimator.simulation.noise import correlated
from estimator.simulation.route import RoadKind, generate_route
from estimator.simulation.sensors import SPEED_RESOLUTION, Sensors
from estimator.simulation.truck import draw_truck

NAMES = ("A", "C", "mass")
LOWER = np.array([500.0, 2.0, 10e3])  # N, N s^2/m^2, kg: the box of the truths, well inside the prior of the fit
UPPER = np.array([3500.0, 6.0, 40e3])
DRIVES: tuple[tuple[RoadKind, float], ...] = (  # kind of road, duration [min]
    ("mixed", 60.0),
    ("highway", 45.0),
    ("urban", 30.0),
    ("mixed", 40.0),
    ("highway", 60.0),
    ("urban", 50.0),
)
METRES_PER_MINUTE = 2000.0  # of road, more than any truck drives
CELL = round(STEP / SIMULATED_STEP)  # simulated steps per row
SPEED_NOISE = 0.01  # m/s
POWER_NOISE = 4e3  # W
PERCENT = 0.01
RANKED = 99  # thinned draws for the rank of a truth
THINNING = 50  # draws of a chain per draw used for the rank
BINS = 10  # of the chi2 test of uniform ranks


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Motion of the truck as means over rows of STEP: all arrays (n,).

    ``columns`` (n, 3) are v, v^3, v a [SI]; ``v`` [m/s]; ``engine_speed`` [rad/s]; ``driving``: clutch closed and
    brakes off throughout the row; ``context`` are the switches that admission looks at.
    """

    columns: Floats
    v: Floats
    engine_speed: Floats
    driving: Mask
    context: dict[Role, Floats]
    reference_torque: float  # N.m

    @classmethod
    def simulate(cls, kind: RoadKind, minutes: float, rng: np.random.Generator) -> "Drive":
        """Drive a truck drawn at random."""
        truck = draw_truck(rng)
        truth = simulation.drive(truck, generate_route(kind, minutes * METRES_PER_MINUTE, rng), minutes * 60, rng)

        def rows(x: Any) -> Any:
            return x[: len(x) // CELL * CELL].reshape(-1, CELL, *x.shape[1:])

        states = {
            Role.BRAKE_SWITCH: rows(truth.braking).any(axis=1),
            Role.SHIFT_IN_PROCESS: rows(truth.shifting).any(axis=1),
            Role.DRIVELINE_ENGAGED: rows(truth.engaged).all(axis=1),
        }
        return cls(
            columns=rows(design(truth.v, truth.a)).mean(axis=1),
            v=rows(truth.v).mean(axis=1),
            engine_speed=rows(truth.engine_speed).mean(axis=1),
            driving=states[Role.DRIVELINE_ENGAGED] & ~states[Role.BRAKE_SWITCH],
            context={role: state.astype(float) for role, state in states.items()},
            reference_torque=truck.reference_torque,
        )

    def power(self, theta: Floats) -> Floats:
        """Power at the wheels [W] (n,) for this motion and ``theta`` = [A, C, m] (3,)."""
        return np.where(self.driving, self.columns @ theta, 0.0)

    def measure(self, power: Floats, rng: np.random.Generator) -> Rows:
        """Rows with noisy speed and the ``power`` [W] (n,) as given."""
        n = len(self.v)
        speed = np.maximum(self.v + rng.normal(0.0, SPEED_NOISE, n), 0.0)
        speed = np.round(speed / SPEED_RESOLUTION) * SPEED_RESOLUTION
        return Rows(
            index=np.arange(n), speed=speed, power=power, fresh=np.ones((n, 2), dtype=bool), context=self.context
        )


Measure = Callable[[Drive, Floats, np.random.Generator], Floats]


def white(drive: Drive, power: Floats, rng: np.random.Generator) -> Floats:
    """``power`` [W] (n,) with white noise."""
    return power + rng.normal(0.0, POWER_NOISE, len(power))


def autoregressive(keep: float) -> Measure:
    """Power with AR(1) noise of correlation ``keep`` from row to row."""

    def measure(drive: Drive, power: Floats, rng: np.random.Generator) -> Floats:
        return power + correlated(len(power), POWER_NOISE, -1 / np.log(keep), rng)

    return measure


def both(drive: Drive, power: Floats, rng: np.random.Generator) -> Floats:
    """``power`` [W] (n,) with AR(1) noise and white noise of the same size."""
    return white(drive, autoregressive(0.9)(drive, power, rng), rng)


def stepped(drive: Drive, power: Floats, rng: np.random.Generator) -> Floats:
    """``power`` [W] (n,) from torque rounded to 1 % of the reference torque, as without SPN 4154, without noise."""
    step = PERCENT * drive.reference_torque
    return np.round(power / drive.engine_speed / step) * step * drive.engine_speed


def stepped_and_noisy(drive: Drive, power: Floats, rng: np.random.Generator) -> Floats:
    """``power`` [W] (n,) from torque with the noise of the simulated sensors, then rounded to 1 %."""
    sensors, n = Sensors(), len(power)
    share = correlated(n, sensors.torque_noise, sensors.torque_correlation / STEP, rng)
    share += rng.normal(0.0, sensors.torque_white_noise, n)
    return stepped(drive, power + share * drive.reference_torque * drive.engine_speed, rng)


CASES: dict[str, Measure] = {
    "white": white,
    "AR(1) 0.9": autoregressive(0.9),
    "AR(1) 0.98": autoregressive(0.98),
    "AR(1) 0.9 + white": both,
    "torque noise, 1 % steps": stepped_and_noisy,
    "1 % steps alone": stepped,
}


@dataclass(frozen=True)
class Outcome:
    """One data set: all arrays (3,) in the order A, C, m."""

    held: Mask  # truth inside the 90 % interval
    rank: NDArray[np.int64]  # of the truth among RANKED draws


def conclude(rows: Rows, theta: Floats, config: Config, rng: np.random.Generator) -> Outcome | None:
    """Posterior from ``rows``, and the rank of the truth ``theta`` = [A, C, m] (3,) in it; None if there is no fit."""
    maker = SampleMaker(config.kinematics, config.admission)
    smoother, _ = maker.calibrate(rows.plausible_speed, rows.power)
    samples = maker.samples(rows, smoother, 0.0, frozenset(), 0.0)  # power and speed are of the same instant
    samples = maker.admit(samples, rows, Counter())
    fit = moments.fit(samples, config.admission.power_sigmas)
    if fit is None:
        return None
    result = posterior.sample(posterior.target_of(fit, config), config, rng)
    marginals = [result.marginal(i) for i in range(3)]
    thinned = result.draws[:, THINNING - 1 :: THINNING, :3].reshape(-1, 3)[:RANKED]
    return Outcome(
        np.array([x.q05 <= truth <= x.q95 for x, truth in zip(marginals, theta, strict=True)]),
        (thinned < theta).sum(axis=0),
    )


def outcomes(
    drives: Sequence[Drive], measure: Measure, sets: int, seed: Sequence[int], config: Config
) -> Iterator[Outcome | None]:
    """Outcomes of ``sets`` data sets; the ``drives`` are used in turn."""
    for k in range(sets):
        rng = np.random.default_rng([*seed, k])
        drive = drives[k % len(drives)]
        theta = rng.uniform(LOWER, UPPER)
        yield conclude(drive.measure(measure(drive, drive.power(theta), rng), rng), theta, config, rng)


def judge(found: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Coverage with its binomial standard error, and p of uniform ranks, for each parameter."""
    held, rank = np.array([x.held for x in found]), np.array([x.rank for x in found])
    figures = {}
    for i, name in enumerate(NAMES):
        coverage = float(held[:, i].mean())
        counts = np.bincount(rank[:, i] * BINS // (RANKED + 1), minlength=BINS)
        error = float(np.sqrt(coverage * (1 - coverage) / len(found)))
        figures[name] = {"coverage": coverage, "error": error, "p": float(chisquare(counts).pvalue)}
    return figures


def main() -> int:
    """Print coverage and p values of every kind of noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=300, help="data sets for each kind of noise")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)
    config = Config()
    drives = [
        Drive.simulate(kind, minutes, np.random.default_rng([options.seed, i]))
        for i, (kind, minutes) in enumerate(track(DRIVES, "driving", console=console, transient=True))
    ]
    figures: dict[str, Any] = {}
    table = Table("power noise", "fits", *(f"{name}: 90 % holds" for name in NAMES), *(f"{name}: p" for name in NAMES))
    for i, (case, measure) in enumerate(CASES.items()):
        every = outcomes(drives, measure, options.sets, [options.seed, 1000 + i], config)
        shown = track(every, case, total=options.sets, console=console, transient=True)
        found = [outcome for outcome in shown if outcome is not None]
        parameters = judge(found)
        figures[case] = {"sets": options.sets, "fits": len(found), **parameters}
        coverage = [f"{100 * x['coverage']:.1f} ± {100 * x['error']:.1f} %" for x in parameters.values()]
        table.add_row(case, str(len(found)), *coverage, *(f"{x['p']:.3f}" for x in parameters.values()))
    if options.json:
        print(json.dumps(figures, indent=2))
    else:
        Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
