"""Pooling of the drives of a vehicle: A/m and C vary slowly over the months, each load has its own mass."""

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
    """Pooled result of the drives of a vehicle.

    ``rolling`` A/m [N/kg] and ``drag`` C [N s^2/m^2] are those at the newest drive, None if not estimated, with the
    ``reasons``. ``trend`` is the mean and sd of their change a year, and ``winter`` of their difference between January
    and July; None if no clock was set. ``compared`` are both at the newest drive of all vehicles, for the comparison of
    vehicles. ``scatter`` (2,) is their sd between drives, ``next_drive`` their prediction for a future drive.
    ``masses`` [kg] are those of the loads given all drives, in the order of the input. ``load`` is the mean and sd [kg]
    of the mass with a future load.
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
        Name of the vehicle.
    loads, starts
        Likelihoods of [1/m, A/m, C/m], one for each load of each drive, and their starts [s].
    gate
        Gate whose ``relative_sd`` is the largest relative sd of an estimate.
    scale
        Scale of the prior of the scatter between drives, as a share; see `pool`.
    doubt
        Reason why the drives must not be pooled, else empty.
    last
        Start of the newest drive of all vehicles [s], if known.
    """
    if doubt or not loads:
        reason = doubt or "no drive with an estimated mass"
        return _nothing(vehicle, reason)
    m, z, V, with_mass, m_variance = _first_order(loads)
    now = newest(starts)
    pooled = pool(z, V, scale, years_since(now, starts))
    estimated, reasons = _shared(pooled, gate)
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
        rolling=estimated[ROLLING],
        drag=estimated[DRAG],
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
    """A/m and C at the newest of some drives, as by `join`; None if not estimated."""
    _, z, V, _, _ = _first_order(loads)
    return _shared(pool(z, V, scale, years_since(newest(starts), starts)), gate)[0]


def _shared(pooled: Pooled, gate: Gate) -> tuple[Known, tuple[str, str]]:
    """A/m and C, None if the sd is too large, and the reasons for None."""
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


def _reason(i: int, marginal: Marginal, largest: float) -> str:
    if marginal.sd <= largest * marginal.mean:
        return ""
    share = 100 * marginal.sd / max(marginal.mean, 1e-12)
    return f"sd of {NAMES[i]} is {min(share, 1000):.0f} % of its value; give more drives"


def _first_order(loads: Sequence[Coefficients]) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Mass (n,), [A/m, C] (n, 2), their covariance (n, 2, 2), that with the mass (n, 2), and variance of the mass (n,).

    The delta method is accurate enough, because the gate allows no mass with a relative sd above a tenth.
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
    """Posteriors of the masses: estimate of each drive, updated with A/m and C of the other drives."""
    gain = np.linalg.solve(V, with_mass[:, :, None])[:, :, 0]
    rest = m_variance - np.einsum("ni,ni->n", gain, with_mass)
    means = m + np.einsum("ni,kni->kn", gain, pooled.drive_mean - z)
    variances = rest + np.einsum("ni,knij,nj->kn", gain, pooled.drive_covariance, gain)
    sds = np.sqrt(np.maximum(variances, (1e-9 * m) ** 2))
    return tuple(Mixture(pooled.weights, means[:, i], sds[:, i]).marginal for i in range(len(m)))
