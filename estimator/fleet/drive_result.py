"""Result of one drive: its estimate for each load, with the statistics that a joint estimate needs."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.blas_threads import one_blas_thread
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.estimates import PARAMETERS, Estimate, Marginal, Status
from estimator.estimation.evidence import Coefficients
from estimator.estimation.road_fit import RoadFit
from estimator.fleet.grouping import Drive
from estimator.fleet.passes import Passes, Places, passes_of
from estimator.fleet.sources import local_copy
from estimator.freed_memory import keep_freed_memory
from estimator.settings import MAX_VALUE
from estimator.streaming.log_frames import LogFrames
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block, Interruption
from estimator.strides import Strides

MINUTE = 60.0  # s


@dataclass(frozen=True)
class Parameter:
    """Status, reason and posterior of one parameter; no posterior if it is not estimated."""

    status: str
    reason: str
    posterior: Marginal | None = None


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Estimate of a drive under one load.

    ``start`` [s] and ``minutes`` [min] are those of its rows. ``parameters`` are m [kg], A [N] and C [N s^2/m^2].
    ``mean`` (3,) and ``covariance`` (3, 3) are those of the likelihood of [1/m, A/m, C/m]; empty if the mass is not
    estimated. ``c_rr`` [1] and ``air_density`` [kg/m^3] are those of `Estimate`.
    """

    start: float
    minutes: float
    status: str
    reason: str
    parameters: dict[str, Parameter]
    mean: list[float]
    covariance: list[list[float]]
    c_rr: Marginal | None = None
    air_density: float | None = None

    @property
    def coefficients(self) -> Coefficients | None:
        """Likelihood of [1/m, A/m, C/m]."""
        return Coefficients(np.array(self.mean), np.array(self.covariance)) if self.mean else None


@dataclass(frozen=True, kw_only=True)
class FoundEffect:
    """Effect that the diagnosis of a drive names, with ``magnitude`` and ``sd`` in ``unit``."""

    name: str
    probability: float
    log_bayes_factor: float
    quantity: str
    magnitude: float
    sd: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class DriveResult:
    """Result of one drive, with its ``passes`` of places; ``fault`` is the reason why there is none, else empty."""

    segments: tuple[Segment, ...] = ()
    passes: Passes = field(default_factory=Passes)
    fault: str = ""
    verdict: str = ""
    effects: tuple[FoundEffect, ...] = ()


@one_blas_thread()
def estimate_drive(drive: Drive, config: Config, with_diagnosis: bool = False) -> DriveResult:
    """Estimate one drive from its files."""
    keep_freed_memory()  # in workers too, which Dask makes give it back
    try:
        with ExitStack() as stack:
            paths = [stack.enter_context(local_copy(source)) for source in drive.sources]
            segments, passes = _segments(paths, config)
            if not with_diagnosis:
                return DriveResult(segments=segments, passes=passes)
            # Imported above, it would be half of a worker's start.
            from estimator.streaming.drive_extraction import diagnose_drive

            diagnosis = diagnose_drive(paths, config)
    except (RoadloadError, OSError) as error:
        return DriveResult(fault=" ".join(str(error).split()))
    named = diagnosis.effects if diagnosis.verdict is Verdict.EFFECT else ()  # else one that may act is among them
    effects = tuple(
        FoundEffect(
            name=finding.name,
            probability=float(finding.probability),
            log_bayes_factor=float(finding.log_bayes_factor),
            quantity=finding.magnitude.name,
            magnitude=float(finding.magnitude.value),
            sd=float(finding.magnitude.sd),
            unit=finding.magnitude.unit,
        )
        for finding in named
    )
    return DriveResult(segments=segments, passes=passes, verdict=diagnosis.verdict.value, effects=effects)


class _Loads:
    """Newest update, times and fitted road of each load of a drive."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._updates: dict[int, tuple[Estimate, Coefficients | None]] = {}
        self._roads: dict[int, tuple[Strides, RoadFit]] = {}
        self._spans: dict[int, tuple[float, float]] = {}

    def take(self, update: Estimate) -> None:
        """Note an update; must be called before the pipeline takes further rows."""
        estimator = self._pipeline.estimator
        evidence = estimator.evidence if update.status is Status.ESTIMATED else None
        self._updates[estimator.segment] = update, None if evidence is None else evidence.coefficients
        self._roads.pop(estimator.segment, None)
        if evidence is not None and evidence.fit is not None:
            fit = evidence.fit
            self._roads[estimator.segment] = estimator.window.strides.without(fit.contradicted), fit

    def doubt(self, segment: int, reason: str) -> None:
        """Make a load unestimated for this reason, and drop its road."""
        self._roads.pop(segment, None)
        if segment in self._updates:
            update, _ = self._updates[segment]
            status = Status.UNESTIMATED
            doubtful = Estimate(
                t=update.t, status=status, reason=reason, coverage=update.coverage, admitted=update.admitted
            )
            self._updates[segment] = doubtful, None

    def rows(self, first: float, last: float) -> None:
        """Note the times [s] of the first and last of some used rows."""
        segment = self._pipeline.estimator.segment
        start, _ = self._spans.get(segment, (first, last))
        self._spans[segment] = start, last

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Loads with an update, in order."""
        return tuple(_segment(*self._updates[i], *self._spans[i]) for i in sorted(self._updates) if i in self._spans)

    def passes(self, places: Places) -> Passes:
        """Passes of places with each load; the fitted roads are then dropped."""
        roads, self._roads = self._roads, {}
        passes = [
            passes_of(strides, fit, places, self._spans[i][0])
            for i, (strides, fit) in sorted(roads.items())
            if i in self._spans
        ]
        return Passes.joined(passes)


def _segments(paths: list[Path], config: Config) -> tuple[tuple[Segment, ...], Passes]:
    """Estimate each load once, at its end: earlier updates of it are not in the result."""
    gate = msgspec.structs.replace(config.gate, interval_s=MAX_VALUE)
    pipeline = Pipeline(msgspec.structs.replace(config, gate=gate))
    loads, places, passes = _Loads(pipeline), Places(), list[Passes]()
    learns_road = config.road.map is None  # what is found with a map holds what the map knew
    for item in pipeline.traffic.feed_all(LogFrames(paths, config)):
        segment = pipeline.estimator.segment
        for update in pipeline.take(item):
            loads.take(update)
        if isinstance(item, Interruption) and item.is_sender_replaced:
            loads.doubt(segment, "a sender was replaced by another, so what the first sent may be wrong")
        if isinstance(item, Interruption) and item.is_step_back:  # times come again, at other places
            passes.append(loads.passes(places))
            places = Places()
        if isinstance(item, Block) and item.rows:
            loads.rows(float(item.rows[0].t[0]), float(item.rows[-1].t[-1]))
            for rows in item.rows if learns_road else ():
                places.add(rows)
    for update in pipeline.finish():
        loads.take(update)
    pipeline.traffic.require_inputs(", ".join(map(str, paths)))
    return loads.segments, Passes.joined([*passes, loads.passes(places)])


def _segment(update: Estimate, coefficients: Coefficients | None, start: float, end: float) -> Segment:
    parameters = {
        name: Parameter(status.value, reason, update.marginals[name])
        for name in PARAMETERS
        for status, reason in [update.status_of(name)]
    }
    return Segment(
        start=start,
        minutes=(end - start) / MINUTE,
        status=update.status.value,
        reason=update.reason,
        parameters=parameters,
        mean=[] if coefficients is None else coefficients.mean.tolist(),
        covariance=[] if coefficients is None else coefficients.covariance.tolist(),
        c_rr=update.c_rr,
        air_density=update.air_density,
    )
