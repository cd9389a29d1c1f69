"""Seasons of a vehicle: A/m and C of its drives in three months of any year."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from estimator.estimates import Marginal
from estimator.estimation.evidence import Coefficients
from estimator.fleet.vehicles import VehicleResult, shared
from estimator.settings import Gate
from estimator.streaming.row_stream import MIN_SET_CLOCK

SEASONS = ("Dec to Feb", "Mar to May", "Jun to Aug", "Sep to Nov")


@dataclass(frozen=True, kw_only=True)
class SeasonResult:
    """Pooled result of the ``loads`` of a vehicle in one season; None for a parameter that is not estimated."""

    season: str
    loads: int
    rolling: Marginal | None
    drag: Marginal | None


def season_of(t: float) -> str:
    """Season of a time [s] in UTC; empty if the clock was not set."""
    return SEASONS[datetime.fromtimestamp(t, UTC).month % 12 // 3] if t >= MIN_SET_CLOCK else ""


def by_season(
    whole: VehicleResult, loads: Sequence[Coefficients], starts: Sequence[float], gate: Gate, scale: float
) -> tuple[SeasonResult, ...]:
    """Pool the loads of a vehicle by season; empty if its drives must not be pooled.

    Parameters
    ----------
    whole
        Result of all loads of the vehicle.
    loads, starts
        Likelihoods of [1/m, A/m, C/m], one for each load, and their starts [s].
    gate, scale
        See `shared`.
    """
    if not whole.masses:
        return ()
    seasons = [season_of(t) for t in starts]
    results = []
    for season in (name for name in SEASONS if name in seasons):
        places = [i for i, name in enumerate(seasons) if name == season]
        chosen, then = [loads[i] for i in places], [starts[i] for i in places]
        if len(chosen) == len(loads):
            rolling, drag = whole.rolling, whole.drag
        else:
            rolling, drag = shared(chosen, then, gate, scale)
        results.append(SeasonResult(season=season, loads=len(chosen), rolling=rolling, drag=drag))
    return tuple(results)
