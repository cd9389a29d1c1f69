"""Components of a drive: effects and processes beside the road load and the road, each a set of columns with a prior.

An effect of the catalogue has one column, its power per unit of magnitude. A nameless process has many: hat functions
along an axis, times what it is proportional to, all with the same prior. So both are judged by the same likelihood.

In the equation of motion a power h comes as the acceleration -h / (m v). Columns that hold the acceleration take the
one that the force gives the vehicle on level ground, less what effects chosen before have taken of it: the measured one
has the road in it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import view_of
from estimator.model.effects.effect import Effect, Timing, View
from estimator.model.spans import Spans
from estimator.model.term import Term
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, Strides


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The strides of a drive and an estimate of the vehicle, from which columns are computed."""

    strides: Strides  # those whose force is known
    force: Floats  # (n,) [N] at the lag of the drive
    road_load: Floats  # [A, C, m]
    lag: float  # s of power behind speed
    taken: Floats  # (n,) [N] of the force, by effects that are known

    @classmethod
    def of(cls, fit: RoadFit) -> "Frame":
        """From a fit of the road model."""
        return cls(
            strides=fit.strides,
            force=fit.strides.force[:, fit.scales.lag],
            road_load=fit.road_load,
            lag=fit.lag,
            taken=fit.taken,
        )

    def disturbed(self, error: Floats) -> "Frame":
        """With an error [N] (n,) in the measured force."""
        return replace(self, force=self.force + error)

    @cached_property
    def view(self) -> View:
        """The quantities that effects are computed from, with the acceleration on level ground."""
        return view_of(self.strides, self.force, self.road_load, self.taken)

    def column(self, term: Term) -> Floats:
        """Acceleration [m/s^2] (n,) per unit of a term's magnitude."""
        return self.as_acceleration(term.column(self.view))

    def as_acceleration(self, power: Floats) -> Floats:
        """Acceleration [m/s^2] (n, ...) lost by a power [W] (n, ...)."""
        taken: Floats = -(power.T / (self.strides.speed * self.road_load[2])).T
        return taken


Columns = Callable[[Frame], Floats]


class Kind(Enum):
    """What a component is to the answer."""

    EFFECT = "an effect of the catalogue"
    PROCESS = "what acts and has no name"
    ROAD = "slopes of the road beside those of its Gaussian process"


@dataclass(frozen=True, kw_only=True)
class Component:
    """One form that a component may take.

    ``columns`` of a frame (n, k): acceleration [m/s^2] per unit of each of its k amplitudes, whose prior is
    N(0, ``sd``^2), or half of it where ``positive``; a size beyond ``largest``, or above ``highest``, is something
    else. ``cost`` is the log prior probability of its times, with the sign changed. ``is_noisy``: noise of the measured
    force is in its columns. ``is_slope``: it is part of the road.
    """

    name: str
    columns: Columns
    sd: float
    positive: bool = False
    largest: float = np.inf
    highest: float = np.inf
    cost: float = 0.0
    is_noisy: bool = False
    is_slope: bool = False
    term: Term | None = None  # of an effect
    spans: Spans | None = None  # when it acts; None: always, or as its columns say

    @property
    def kind(self) -> Kind:
        """What it is to the answer."""
        if self.term is not None:
            return Kind.EFFECT
        return Kind.ROAD if self.is_slope else Kind.PROCESS

    @property
    def is_timed(self) -> bool:
        """Whether its times were fitted: neither always nor from a standstill on."""
        return self.spans is not None and (self.term is None or self.term.effect.timing is not Timing.STEP)


def of_effect(frame: Frame, effect: Effect, known: frozenset[Quantity]) -> list[Component]:
    """All forms of an effect whose times are given: its shapes, or each standstill that it may begin at."""
    shapes = effect.usable_shapes(known)
    terms = [Term(effect, shape) for shape in shapes if effect.timing is Timing.ALWAYS or shape is not None]
    if effect.timing is Timing.STEP:
        terms = [Term(effect, None, spans) for spans in _from_standstills(frame.strides)]
    return [of_term(frame, term) for term in terms]


def of_term(frame: Frame, term: Term, cost: float = 0.0) -> Component:
    """A term of the catalogue as a component."""
    effect = term.effect
    return Component(
        name=effect.name,
        columns=lambda frame: frame.column(term)[:, None],
        sd=effect.usual(frame.road_load),
        positive=effect.positive,
        largest=effect.limit(frame.road_load),
        highest=effect.highest,
        cost=cost,
        is_noisy=effect.is_noisy,
        term=term,
        spans=term.spans,
    )


def as_terms(frame: Frame, process: Component) -> list[Term]:
    """The columns of what is no effect as terms of a fit, each with the prior of its amplitude."""
    power = _Powers(frame, process)
    return [Term(_of_process(process, power, k), usual_sds=1.0) for k in range(power.count)]


class _Powers:
    """Power [W] (n, k) of a process, for the force that a view of the frame's strides has; kept for the last view."""

    def __init__(self, frame: Frame, process: Component) -> None:
        self._frame, self._process = frame, process
        self._view: View | None = None
        self._power = self._of(frame.force)
        self.count = self._power.shape[1]

    def __call__(self, view: View) -> Floats:
        if self._process.is_noisy and view is not self._view:
            self._view, self._power = view, self._of(view.P / view.v)
        return self._power

    def _of(self, force: Floats) -> Floats:
        frame = replace(self._frame, force=force)
        power: Floats = -self._process.columns(frame) * (frame.road_load[2] * frame.strides.speed)[:, None]
        return power


def _of_process(process: Component, power: _Powers, k: int) -> Effect:
    """An effect whose power is that of one column of a process."""
    return Effect(
        name=process.name,
        equation="",
        source="",
        symbol="",
        unit="1",
        power=lambda view, shape: power(view)[:, k],
        usual=lambda road_load: process.sd,
        positive=False,
        is_noisy=True,  # or its columns are known at the frame's strides only
        is_gravity=process.is_slope,
    )


def _from_standstills(strides: Strides) -> Iterator[Spans]:
    """From each standstill to the end of the drive, where enough was driven on both sides."""
    stops = strides.context.get(Quantity.STOPS, np.zeros(len(strides)))
    for k in range(1, int(np.nanmax(stops, initial=0)) + 1):
        after = stops >= k
        if 0.05 < after.mean() < 0.95:
            yield ((float(strides.t[np.argmax(after)]) - DURATION / 2, float(strides.t[-1]) + DURATION / 2),)
