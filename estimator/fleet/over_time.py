"""Change of A/m and C of a vehicle over the months: a trend, and a season of one year.

    value(t) = now + trend t + c (cos 2 pi t - 1) + s sin 2 pi t,   t [years] since the newest drive

Here `now` is the value at the newest drive. The priors of the other terms are shares of the value. Tyres lose a fifth
of their rolling resistance until they are worn, and new ones restore it. Rolling resistance falls by 0.6 % a kelvin
(ISO 28580, correction to 25 degC for tyres of heavy vehicles), and the density of the air by 1/T. The mean day of
summer or winter is some 10 K off that of the year.
"""

from collections.abc import Sequence

import numpy as np

from estimator.fleet.grouping import CLOCK_YEARS, YEAR, years_off
from estimator.signals import Floats

COLDEST = 19.0 * 86_400.0  # s since the year began: 20 January, in the north
SWING = 10.0  # K, of the daily mean about that of the year
BY_KELVIN = np.array([0.006, 1 / 288.0])  # change of A/m and C, as a share
BY_YEAR = (0.1, 0.02)  # sd of the trend of A/m and C, as a share a year
NOW, TREND = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])  # among the terms
_SEASON = SWING * BY_KELVIN / np.sqrt(2)  # sd of c and s, whose squares add up
PRIOR_SD = np.column_stack([[np.inf, np.inf], BY_YEAR, _SEASON, _SEASON])  # (2, 4) of the terms, shares of A/m and C


def newest(starts: Sequence[float]) -> float | None:
    """Start [s] of the newest drive whose clock is trusted; None if there is none."""
    return max((start for start, is_trusted in zip(starts, _trusted(starts), strict=True) if is_trusted), default=None)


def years_since(now: float | None, starts: Sequence[float]) -> Floats:
    """Times [years] (n,) since ``now`` of drives that began at ``starts`` [s]; 0 without ``now`` or a trusted clock."""
    if now is None:
        return np.zeros(len(starts))
    return np.where(_trusted(starts), (np.array(starts, dtype=np.float64) - now) / YEAR, 0.0)


def _trusted(starts: Sequence[float]) -> list[bool]:
    """Flag (n,) the drives whose clock was set and differs by at most CLOCK_YEARS from the median."""
    return [years is not None and abs(years) <= CLOCK_YEARS for years in years_off(starts)]


def terms(years: Floats) -> Floats:
    """Columns (n, 4) of now, trend, c and s at ``years`` (n,) since the newest drive."""
    angle = 2 * np.pi * years
    return np.column_stack([np.ones(len(years)), years, np.cos(angle) - 1, np.sin(angle)])


def winter(now: float) -> Floats:
    """Difference (4,) of the columns in January and July, without the trend, for a newest drive at ``now`` [s]."""
    january = (COLDEST - now) / YEAR
    cold, warm = terms(np.array([january, january + 0.5]))
    difference: Floats = (cold - warm) * (1 - TREND)
    return difference
