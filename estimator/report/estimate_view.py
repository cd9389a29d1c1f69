"""An estimate and what it rests on, as picture and page show it; every curve is of the fit behind the answer."""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from estimator.answers.run import CoverageMap
from estimator.estimates import Estimate, Status
from estimator.estimation.evidence import Evidence
from estimator.report import parameter_text, summary
from estimator.report.export import NAMES
from estimator.report.page.series import telling_minutes
from estimator.report.parameter_text import ROWS, Row
from estimator.signals import Floats
from estimator.streaming.replay import Run
from estimator.streaming.row_stream import MIN_SET_CLOCK

WIDEST = 8.0  # times the newest interval: wider ones, of the beginning, may leave the drawing
DRAWN = 800  # draws of the posterior that are drawn


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A parameter over time, in its unit; all arrays (n,), NaN where it was not estimated; ``t`` [s]."""

    t: Floats
    low: Floats
    mean: Floats
    high: Floats

    @property
    def answer(self) -> slice:
        """The newest point if the last update has a value, else none: an older value is no answer."""
        return slice(len(self.t) - 1, len(self.t) if np.isfinite(self.mean[-1]) else len(self.t) - 1)

    @property
    def range(self) -> tuple[float, float]:
        """Least and greatest end of the intervals up to WIDEST times the newest; NaN where none is known."""
        known = np.flatnonzero(np.isfinite(self.mean))
        if not len(known):
            return np.nan, np.nan
        width = self.high - self.low
        near = known[width[known] <= WIDEST * width[known[-1]]]
        return float(self.low[near].min()), float(self.high[near].max())


@dataclass(frozen=True, kw_only=True)
class PowerTrace:
    """Power [kW] (n,) over the time ``t`` [s] (n,) since the first frame, with a NaN of all three at every break."""

    t: Floats
    measured: Floats
    fitted: Floats

    @property
    def residual(self) -> Floats:
        """Measured less fitted power [kW] (n,)."""
        return self.measured - self.fitted

    def __getitem__(self, part: slice) -> "PowerTrace":
        return PowerTrace(t=self.t[part], measured=self.measured[part], fitted=self.fitted[part])

    @property
    def telling(self) -> "PowerTrace":
        """The minutes in which the fit misses most."""
        last = np.maximum.accumulate(np.nan_to_num(self.t, nan=-np.inf))
        return self[telling_minutes(last, np.nan_to_num(self.residual**2))]


@dataclass(frozen=True, kw_only=True)
class EstimateView:
    """The last of some ``updates``, all of them, the coverage, and the evidence behind the last.

    ``title`` names the logs, ``start`` is the time of the first frame [s]; ``evidence`` is None where the last update
    has no values. ``warnings`` are of what widens the estimate.
    """

    title: str
    start: float
    updates: tuple[Estimate, ...]
    cells: CoverageMap
    evidence: Evidence | None
    warnings: tuple[str, ...] = ()

    @property
    def final(self) -> Estimate:
        """The answer."""
        return self.updates[-1]

    @property
    def headline(self) -> str:
        """``27,161 kg (27,012 .. 27,314)``, or the status and its reason."""
        final = self.final
        reason = f": {final.reason}" if final.reason else ""
        return parameter_text.mass(summary.parameters(final)) or f"{final.status.value}{reason}"

    @property
    def date(self) -> str:
        """Date and time of the first frame; empty where the clock was not set."""
        return f"{datetime.fromtimestamp(self.start, UTC):%Y-%m-%d %H:%M} UTC" if self.start >= MIN_SET_CLOCK else ""

    def curve(self, row: Row) -> Curve:
        """One of the parameters at every update."""
        past = [summary.past(update, self.start) for update in self.updates]
        points = [getattr(point, row.key) for point in past]
        low, mean, high = (
            np.array([np.nan if point is None else getattr(point, part) for point in points])
            for part in ("q05", "mean", "q95")
        )
        return Curve(t=np.array([point.t_s for point in past]), low=low, mean=mean, high=high)

    @property
    def power(self) -> PowerTrace | None:
        """Power over all strides of the fit; None without a fit."""
        if self.evidence is None:
            return None
        trace = self.evidence.trace
        breaks = np.flatnonzero(np.diff(trace.t) > 1.5 * trace.spacing) + 1
        t, measured, fitted = (
            np.insert(values, breaks, np.nan) for values in (trace.t - self.start, trace.P / 1e3, trace.fitted / 1e3)
        )
        return PowerTrace(t=t, measured=measured, fitted=fitted)

    @property
    def rows(self) -> tuple[Row, ...]:
        """The parameters that are estimated: draws of one that is withheld are no answer."""
        known = summary.parameters(self.final)
        return tuple(row for row in ROWS if row.of(known).mean is not None)

    def chains(self, row: Row) -> Floats:
        """Draws (chains, draws) of a parameter; none without evidence."""
        return np.empty((0, 0)) if self.evidence is None else self.evidence.posterior.draws[:, :, NAMES.index(row.key)]

    def draws(self, row: Row) -> Floats:
        """Draws (n,) of a parameter over all chains, evenly thinned to at most DRAWN."""
        flat = self.chains(row).ravel()
        return flat[:: max(-(-len(flat) // DRAWN), 1)]


def view_of(run: Run, title: str) -> EstimateView:
    """The view of a run of logs."""
    final, pipeline = run.final, run.pipeline
    return EstimateView(
        title=title,
        start=run.start,
        updates=tuple(run.updates),
        cells=summary.coverage_map(pipeline.estimator.window, pipeline.config.gate, final),
        evidence=evidence_of(run),
        warnings=summary.warnings(run),
    )


def evidence_of(run: Run) -> Evidence | None:
    """The evidence behind the last update; None where that has no values, as while an input is contested."""
    return run.pipeline.estimator.evidence if run.final.status is Status.ESTIMATED else None
