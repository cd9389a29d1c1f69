"""Table 5: the computation that reproduces the printed eigen-metrics, found by trying all combinations of choices.

The paper does not print the units of P in J = dP / d theta, the choice of samples or the formula for dv/dt. Each
combination of these gives three eigenvalues of J' J and the angle between the axis of A and the nearest eigenvector,
for each cycle; `search` ranks all combinations by their distance from the printed numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimator.model.road_load import design, power
from estimator.sampling.identifiability import eigen_metrics
from estimator.signals import Floats, Mask
from paper.printed import PRINTED, PrintedCycle
from paper.vehicles import FOOT, LBF, MPH, NOMINAL, SLUG, TO_SI

FPS = MPH / FOOT  # ft/s per mph
POUND = 0.45359237  # kg

# Column v a, in mph and mph/s, times this gives the power in lbf mph for each unit of mass.
MASS_UNITS = {"slug": FPS, "lbf/(mph/s)": 1.0, "lbm": FPS * POUND / SLUG, "slug, a in m/s²": MPH}
POWER_UNITS = {"lbf mph": 1.0, "lbf ft/s": FPS, "hp": FPS / 550, "W": LBF * MPH}
FACTORS = {"JᵀJ": 1.0, "2 JᵀJ": 2.0}  # of the matrix: 2 for the Hessian of chi2, or for two samples a second
TRACES = ("as scheduled", "mean of 3 s", "mean of 5 s", "at most 250 kW", "at most 200 kW", "at most 150 kW")
WOBBLES = (0.0, 0.03, 0.06, 0.09)  # m/s, sd of white noise in the speed
DERIVATIVES: dict[str, Callable[[Floats], Floats]] = {
    "central": np.gradient,
    "forward": lambda v: np.append(np.diff(v), 0.0),
    "backward": lambda v: np.insert(np.diff(v), 0, 0.0),
}
SELECTIONS = ("all", "model P > 0", "measured P > 0")
PARAMETERS = ("estimates", "nominal")  # with which the power is computed that selects samples
SEED = 5
MIN_LIMITED_SPEED = 2.0  # m/s, below which the power limit allows no more acceleration


@dataclass(frozen=True, kw_only=True)
class Units:
    """Unit of the mass, unit of power and factor of the matrix: keys of MASS_UNITS, POWER_UNITS and FACTORS."""

    mass: str
    power: str
    factor: str

    @property
    def scale(self) -> Floats:
        """Multipliers (3,) of the columns v, v^3, v a in mph and mph/s."""
        power: float = np.sqrt(FACTORS[self.factor]) * POWER_UNITS[self.power]
        return power * np.array([1.0, 1.0, MASS_UNITS[self.mass]])


@dataclass(frozen=True, kw_only=True)
class Processing:
    """Trace, noise of its speed [m/s], formula for dv/dt, choice of samples and the parameters used for that."""

    trace: str = "as scheduled"
    wobble: float = 0.0
    derivative: str = "central"
    selection: str = "model P > 0"
    parameters: str = "estimates"


@dataclass(frozen=True, kw_only=True)
class Match:
    """Eigen-metrics of one combination, by cycle, and their differences from the printed ones.

    ``log10_eigenvalues`` (cycles, 3), and ``nearest`` (cycles, 3): indices of the parameters whose axes are nearest
    to their eigenvectors; ``angles`` (cycles, 3) [deg] of the axes of A, C and m to the nearest eigenvector;
    ``differences`` (cycles, 4): log10 of the three eigenvalues and of the tangent of A's angle.
    """

    units: Units
    processing: Processing
    log10_eigenvalues: Floats
    nearest: NDArray[np.intp]
    angles: Floats
    differences: Floats

    @property
    def rms(self) -> float:
        """Root mean square of the differences."""
        return float(np.sqrt(np.mean(self.differences**2)))


def search(parts: dict[str, tuple[Floats, ...]]) -> list[Match]:
    """All combinations on the cycles ``parts`` (speeds [m/s]), the nearest to the printed numbers first."""
    units = [Units(mass=m, power=p, factor=f) for m, p, f in product(MASS_UNITS, POWER_UNITS, FACTORS)]
    matches = []
    for trace, wobble, derivative in product(TRACES, WOBBLES, DERIVATIVES):
        for selection, parameters in product(SELECTIONS, PARAMETERS):
            if selection == "all" and parameters != PARAMETERS[0]:
                continue  # the parameters select nothing
            processing = Processing(
                trace=trace, wobble=wobble, derivative=derivative, selection=selection, parameters=parameters
            )
            information = {name: raw_information(name, speeds, processing) for name, speeds in parts.items()}
            matches += [compare(information, processing, unit) for unit in units]
    return sorted(matches, key=lambda match: match.rms)


def compare(information: dict[str, Floats], processing: Processing, units: Units) -> Match:
    """Eigen-metrics of J' J (3, 3) by cycle [mph, mph/s], taken to ``units``, beside the printed ones."""
    logarithms, nearest, angles, differences = [], [], [], []
    for name, matrix in information.items():
        metrics = eigen_metrics(matrix, units.scale)
        rotation = metrics.angles.min(axis=0)
        printed = PRINTED[name]
        tangents = np.tan(np.radians([rotation[0], printed.angles[0]]))
        off = metrics.log10_eigenvalues - printed.log10_eigenvalues
        logarithms.append(metrics.log10_eigenvalues)
        nearest.append(metrics.angles.argmin(axis=1))
        angles.append(rotation)
        differences.append([*off, np.log10(tangents[0] / tangents[1])])
    return Match(
        units=units,
        processing=processing,
        log10_eigenvalues=np.array(logarithms),
        nearest=np.array(nearest),
        angles=np.array(angles),
        differences=np.array(differences),
    )


def raw_information(name: str, speeds: tuple[Floats, ...], processing: Processing) -> Floats:
    """J' J (3, 3) of the columns v, v^3, v a in mph and mph/s over the samples that ``processing`` selects."""
    differentiate = DERIVATIVES[processing.derivative]
    driven = [_driven(v, processing.trace) for v in speeds]
    used = [_recorded(v, processing, part) for part, v in enumerate(driven)]
    v, a = np.concatenate(used), np.concatenate([differentiate(part) for part in used])
    theta = NOMINAL if processing.parameters == "nominal" else PRINTED[name].estimates.mean(axis=0) * TO_SI
    mask: Mask = np.ones(len(v), dtype=bool)
    if processing.selection == "model P > 0":
        mask = power(v, a, theta) > 0
    elif processing.selection == "measured P > 0":
        true_v, true_a = np.concatenate(driven), np.concatenate([np.gradient(part) for part in driven])
        mask = power(true_v, true_a, theta) > 0
    J = design(v / MPH, a / MPH)[mask]
    return J.T @ J


def _driven(v: Floats, trace: str) -> Floats:
    """Speed [m/s] of the vehicle for the schedule ``v``: later than scheduled where a power limit binds."""
    if not trace.startswith("at most"):
        return v
    watts = 1e3 * float(trace.split()[2])
    A, C, m = NOMINAL
    driven = v.copy()
    for i in range(1, len(v)):
        before = driven[i - 1]
        most = (watts / max(before, MIN_LIMITED_SPEED) - A - C * before**2) / m
        driven[i] = min(v[i], before + most)
    return driven


def _recorded(v: Floats, processing: Processing, part: int) -> Floats:
    """Speed [m/s] as measured and filtered before it is used."""
    v = v + processing.wobble * np.random.default_rng((SEED, part)).standard_normal(len(v))
    if not processing.trace.startswith("mean"):
        return v
    seconds = int(processing.trace.split()[2])
    return np.convolve(np.pad(v, seconds // 2, mode="edge"), np.full(seconds, 1 / seconds), "valid")


def printed_information(cycle: PrintedCycle) -> Floats:
    """J' J (3, 3) of [A, C, m] in lbf ft/s per printed unit, put together from a row of Table 5.

    The printed angles belong to A and m, which rotate in their plane, and to C, which tilts towards A: see the page.
    """
    plane, tilt = np.radians(cycle.angles[[0, 2]])
    largest, second, weakest = 10.0**cycle.log10_eigenvalues
    turn = np.array([[np.cos(tilt), np.sin(tilt), 0.0], [-np.sin(tilt), np.cos(tilt), 0.0], [0.0, 0.0, 1.0]])
    axes = np.array([[0.0, np.sin(plane), np.cos(plane)], [1.0, 0.0, 0.0], [0.0, np.cos(plane), -np.sin(plane)]])
    vectors = turn @ axes
    information: Floats = vectors @ np.diag([largest, second, weakest]) @ vectors.T
    return information


def angle(x: Floats, y: Floats) -> tuple[float, float]:
    """Angle from the axis of ``x`` (n,) towards that of ``y`` (n,) by regression [deg], and its standard deviation."""
    x, y = x - x.mean(), y - y.mean()
    slope = x @ y / (x @ x)
    sd = np.sqrt(((y - slope * x) ** 2).sum() / (len(x) - 2) / (x @ x))
    return float(np.degrees(np.arctan(abs(slope)))), float(np.degrees(sd / (1 + slope**2)))
