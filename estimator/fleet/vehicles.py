"""A vehicle over its drives: rolling coefficient A/m and drag C change with the months, each load has its own mass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.estimates import Marginal, Status
from estimator.estimation.evidence import Coefficients
from estimator.fleet.grouping import YEAR
from estimator.fleet.over_time import NOW, TREND, newest, terms, winter, years_since
from estimator.fleet.pooling import Mixture, Pooled, pool
from estimator.model.road_load import NEW_LOAD_SD
from estimator.settings import Gate
from estimator.signals import Floats

ROLLING, DRAG = 0, 1  # components of what drives share: A/m [N/kg], C [N s^2/m^2]
NAMES = ("A/m", "C")
Normal = tuple[float, float]  # mean and sd
Known = tuple[Marginal | None, Marginal | None]  # A/m and C


@dataclass(frozen=True, kw_only=True)
class VehicleResult:
    """The pooled result of the drives of a vehicle.

    ``rolling`` A/m [N/kg] and ``drag`` C [N s^2/m^2] at the newest drive, None where they are not estimated, with the
    ``reasons``; mean and sd of their ``trend`` [a year] and of what they are in January above July (``winter``), None
    where no clock was set; both as ``compared`` with other vehicles, at the newest drive of all; their ``scatter``
    between drives (2,); ``next_drive`` is what to expect of A/m and C on a drive to come; ``masses`` [kg] of the loads,
    given all drives, in the order of what was passed in; ``load`` mean and sd [kg] of the mass under a load to come.
    """

    vehicle: str
    status: str
    reasons: tuple[str, str]
    rolling: Marginal | None
    drag: Marginal | None
    trend: tuple[Normal, Normal] | None
    winter: tuple[Normal, Normal] | None
    compared: Known
    scatter: tuple[float, float]
    next_drive: tuple[Marginal, Marginal] | None
    masses: tuple[Marginal, ...]
    load: tuple[float, float] | None


def join(
    vehicle: str,
    loads: Sequence[Coefficients],
    starts: Sequence[float],
    gate: Gate,
    scale: float,
    doubt: str = "",
    last: float | None = None,
) -> VehicleResult:
    """Estimate a vehicle from the likelihoods of its drives.

    Parameters
    ----------
    vehicle
        Its name.
    loads, starts
        Likelihoods of [1/m, A/m, C/m], one for each load of each drive, and when it begins [s].
    gate
        Whose ``relative_sd`` bounds the relative sd of an estimate.
    scale
        Scale of the prior of the scatter between drives, as a share; see `pool`.
    doubt
        Why the drives must not be joined, or empty.
    last
        When the newest drive of all vehicles began [s], if known.
    """
    if doubt or not loads:
        reason = doubt or "no drive with an estimated mass"
        return _nothing(vehicle, reason)
    m, z, V, with_mass, m_variance = _first_order(loads)
    now = newest(starts)
    pooled = pool(z, V, scale, years_since(now, starts))
    known, reasons = _shared(pooled, gate)
    masses = _masses(m, z, V, with_mass, m_variance, pooled)
    at = NOW if now is None or last is None else terms(np.array([(last - now) / YEAR]))[0]
    means = np.array([mass.mean for mass in masses])
    mean = float(means.mean())
    # The mean of n known loads is uncertain by NEW_LOAD_SD / sqrt(n).
    spread = float(np.sqrt((NEW_LOAD_SD * mean) ** 2 / len(means) + means.var()))
    return VehicleResult(
        vehicle=vehicle,
        status=Status.UNESTIMATED if all(reasons) else Status.ESTIMATED,
        reasons=reasons,
        rolling=known[ROLLING],
        drag=known[DRAG],
        trend=None if now is None else _pair(pooled, TREND),
        winter=None if now is None else _pair(pooled, winter(now)),
        compared=(
            None if reasons[ROLLING] else pooled.combined(ROLLING, at).marginal,
            None if reasons[DRAG] else pooled.combined(DRAG, at).marginal,
        ),
        scatter=(pooled.scatter(ROLLING), pooled.scatter(DRAG)),
        next_drive=(pooled.predicted(ROLLING).marginal, pooled.predicted(DRAG).marginal),
        masses=masses,
        load=(mean, spread),
    )


def shared(loads: Sequence[Coefficients], starts: Sequence[float], gate: Gate, scale: float) -> Known:
    """A/m and C at the newest of some drives, as `join` finds them; None where they are not estimated."""
    _, z, V, _, _ = _first_order(loads)
    return _shared(pool(z, V, scale, years_since(newest(starts), starts)), gate)[0]


def _shared(pooled: Pooled, gate: Gate) -> tuple[Known, tuple[str, str]]:
    """A/m and C where their sd is small enough, and the reasons where it is not."""
    rolling, drag = (pooled.shared(i).marginal for i in (ROLLING, DRAG))
    reasons = _reason(ROLLING, rolling, gate.relative_sd[ROLLING]), _reason(DRAG, drag, gate.relative_sd[DRAG])
    return (None if reasons[ROLLING] else rolling, None if reasons[DRAG] else drag), reasons


def _nothing(vehicle: str, reason: str) -> VehicleResult:
    return VehicleResult(
        vehicle=vehicle,
        status=Status.UNESTIMATED,
        reasons=(reason, reason),
        rolling=None,
        drag=None,
        trend=None,
        winter=None,
        compared=(None, None),
        scatter=(0.0, 0.0),
        next_drive=None,
        masses=(),
        load=None,
    )


def _pair(pooled: Pooled, share: Floats) -> tuple[Normal, Normal]:
    return pooled.combined(ROLLING, share).moments, pooled.combined(DRAG, share).moments


def _reason(i: int, found: Marginal, largest: float) -> str:
    if found.sd <= largest * found.mean:
        return ""
    share = 100 * found.sd / max(found.mean, 1e-12)
    return f"sd of {NAMES[i]} is {min(share, 1000):.0f} % of its value; give more drives"


def _first_order(loads: Sequence[Coefficients]) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Mass (n,), [A/m, C] (n, 2), its covariance (n, 2, 2), that with the mass (n, 2), and the mass's variance (n,).

    By the delta method: the gate lets no mass pass whose relative sd is over a tenth.
    """
    mean = np.array([load.mean for load in loads])
    covariance = np.array([load.covariance for load in loads])
    m, C = 1 / mean[:, 0], mean[:, 2] / mean[:, 0]
    jacobian = np.zeros((len(m), 3, 3))  # of [m, A/m, C]
    jacobian[:, 0, 0] = -(m**2)
    jacobian[:, 1, 1] = 1.0
    jacobian[:, 2, 0], jacobian[:, 2, 2] = -C * m, m
    spread = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return m, np.column_stack([mean[:, 1], C]), spread[:, 1:, 1:], spread[:, 1:, 0], spread[:, 0, 0]


def _masses(
    m: Floats, z: Floats, V: Floats, with_mass: Floats, m_variance: Floats, pooled: Pooled
) -> tuple[Marginal, ...]:
    """Posteriors of the masses: each drive's own, updated with A/m and C of the other drives."""
    gain = np.linalg.solve(V, with_mass[:, :, None])[:, :, 0]
    rest = m_variance - np.einsum("ni,ni->n", gain, with_mass)
    means = m + np.einsum("ni,kni->kn", gain, pooled.drive_mean - z)
    variances = rest + np.einsum("ni,knij,nj->kn", gain, pooled.drive_covariance, gain)
    sds = np.sqrt(np.maximum(variances, (1e-9 * m) ** 2))
    return tuple(Mixture(pooled.weights, means[:, i], sds[:, i]).marginal for i in range(len(m)))
