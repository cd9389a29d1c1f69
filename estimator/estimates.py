"""The estimate of one update, which is printed, broadcast and stored."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from math import sqrt

from estimator.units import STANDARD_DENSITY

PARAMETERS = ("A", "C", "m")  # order of every parameter vector: [N], [N s^2/m^2], [kg]


class Status(StrEnum):
    """Whether the parameters may be used."""

    UNESTIMATED = "unestimated"  # not enough shown yet, or the sampler did not converge
    ESTIMATED = "estimated"
    INVALID = "invalid"  # the model cannot describe the data


@dataclass(frozen=True, slots=True, kw_only=True)
class Marginal:
    """Posterior of one parameter: moments and quantiles in its own unit."""

    mean: float
    sd: float
    q05: float
    q50: float
    q95: float

    def times(self, factor: float) -> "Marginal":
        """Posterior of the parameter times a positive ``factor``."""
        return Marginal(**{name: factor * value for name, value in asdict(self).items()})


def drag_area(C: Marginal, density: float | None) -> Marginal:
    """Return c_d A = 2 C / density [m^2] from C [N s^2/m^2] in air of a density [kg/m^3]; None: the standard's."""
    return C.times(2 / (density or STANDARD_DENSITY))


@dataclass(frozen=True, slots=True, kw_only=True)
class Convergence:
    """Convergence diagnostics of the chains (Vehtari et al. 2021): worst value over the parameters."""

    r_hat: float
    ess_bulk: float
    acceptance: float
    draws: int  # kept, per chain
    chains: int


@dataclass(frozen=True, slots=True)
class Coverage:
    """Occupied cells of the speed x acceleration grid, of those this vehicle can reach.

    ``wanted`` are the numbers on the grid of those it can reach and that are not occupied.
    """

    occupied: int
    available: int
    wanted: tuple[int, ...] = ()

    @property
    def fraction(self) -> float:
        """Share of the reachable cells that were driven."""
        return self.occupied / self.available if self.available else 0.0


@dataclass(frozen=True, slots=True)
class LoadChange:
    """Whether the mass after a stop is another one than before: ``probability``, and both means [kg]."""

    probability: float
    before: float
    after: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Road:
    """Slopes of the road by the model.

    ``slope_sd`` standard deviation of the slope along it [1], ``length`` over which it changes [m], ``shown_by`` the
    signals that show it, none for a hidden road; ``climbed`` height gained on the way up [m], None where no signal
    shows it. ``contradicted``: signals that do not show it: they never change, fall where it climbs, or the force and
    the others show another road.
    """

    slope_sd: float
    length: float
    shown_by: tuple[str, ...]
    climbed: float | None
    contradicted: tuple[str, ...] = ()


def not_showing(signals: Sequence[str]) -> str:
    """Clause that says which ``signals`` of the road do not show it; empty where all do."""
    if not signals:
        return ""
    reason = "without a change, of the wrong sign, or contradicted by the force and the other signals"
    return f"; {' and '.join(signals)} {'does' if len(signals) == 1 else 'do'} not show it: {reason}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Slope:
    """The road under the vehicle at message time ``t`` [s].

    ``sine`` of the slope and its standard deviation ``sd`` [1]; ``height`` above the start of the drive and its
    ``height_sd`` [m], NaN where no signal shows the road.
    """

    t: float
    sine: float
    sd: float
    height: float
    height_sd: float

    @property
    def grade(self) -> float:
        """Rise over run [1]."""
        return self.sine / sqrt(1 - self.sine**2)

    @property
    def grade_sd(self) -> float:
        """Standard deviation of the grade [1], to first order: d tan = d sin / cos^3."""
        return float(self.sd / (1 - self.sine**2) ** 1.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Conclusion at message time ``t`` [s]; "estimated" when the mass is.

    The marginals are None unless they are estimated.
    """

    t: float
    status: Status
    reason: str
    coverage: Coverage
    admitted: int  # samples in the window
    mass: Marginal | None = None  # [kg]
    A: Marginal | None = None  # [N]
    C: Marginal | None = None  # [N s^2/m^2]
    convergence: Convergence | None = None
    rms: float | None = None  # [W] of the power residual
    effects: dict[str, Marginal] = field(default_factory=dict)  # magnitudes of effects in the model
    load: LoadChange | None = None  # against the load before the last long stop, where that was estimated
    withheld: dict[str, str] = field(default_factory=dict)  # reason, for each of PARAMETERS that is not known yet
    road: Road | None = None  # where the model has one
    c_rr: Marginal | None = None  # A / (m g) [1], by the mass that is estimated, rotating parts included
    air_density: float | None = None  # [kg/m^3] that C holds for; None where no signal shows it
    doubt: str = ""  # why a unit may be wrong although the estimate stands
    remedy: str | None = None  # what to do about the reason; empty where that says it, None where nothing sure is known

    @property
    def marginals(self) -> dict[str, Marginal | None]:
        """The marginals in the order of PARAMETERS."""
        return {"A": self.A, "C": self.C, "m": self.mass}

    def status_of(self, parameter: str) -> tuple[Status, str]:
        """Whether one of PARAMETERS may be used, and the reason why not."""
        if self.status is Status.ESTIMATED and self.marginals[parameter] is None:
            return Status.UNESTIMATED, self.withheld.get(parameter, "")
        return self.status, self.reason
