"""Represent effects, nameless processes and stretches of road on one drive as terms: columns with a prior.

A hypothesis is a set of terms. An effect of the catalogue, with one shape and its times, is an `EffectTerm`; its term
here has one column, the power per unit of magnitude. The term of a nameless process has many columns: hat functions
along an axis, times a profile (such as the speed), all with the same prior. One likelihood evaluates both.

In the equation of motion a power h appears as the acceleration -h / (m v). Columns computed from the acceleration use
that of the measured force on level ground, less the force of the effects in the fit: the measured acceleration contains
the slope.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import view_of
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import Effect, Timing, View
from estimator.model.spans import Spans
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, Strides


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Strides of a drive and an estimate of the vehicle, from which columns are computed."""

    strides: Strides  # strides whose force is known
    force: Floats  # (n,) [N], at the lag of the drive
    road_load: Floats  # [A, C, m]
    lag: float  # s, by which power comes after speed
    effect_force: Floats  # (n,) [N], force of the fit's effects that are not computed from the force

    @classmethod
    def of(cls, fit: RoadFit) -> "Frame":
        """Frame of a fit of the road model."""
        return cls(
            strides=fit.strides,
            force=fit.force,
            road_load=fit.road_load,
            lag=fit.lag,
            effect_force=fit.taken,
        )

    def disturbed(self, error: float) -> "Frame":
        """Copy with an ``error`` [N] added to the measured force."""
        return replace(self, force=self.force + error)

    @cached_property
    def view(self) -> View:
        """Quantities that effects are computed from, with the acceleration on level ground."""
        return view_of(self.strides, self.force, self.road_load, self.effect_force)

    def column(self, effect_term: EffectTerm) -> Floats:
        """Acceleration [m/s^2] (n,) per unit of an effect's magnitude."""
        return self.as_acceleration(effect_term.column(self.view))

    def as_acceleration(self, power: Floats) -> Floats:
        """Acceleration -P / (m v) [m/s^2] (n, ...) caused by a consumed power P [W] (n, ...)."""
        acceleration: Floats = -(power.T / (self.strides.speed * self.road_load[2])).T
        return acceleration


Columns = Callable[[Frame], Floats]


class Kind(Enum):
    """Category of a term in the answer."""

    EFFECT = "an effect of the catalogue"
    PROCESS = "what acts and has no name"
    ROAD = "slopes of the road beside those of its Gaussian process"


@dataclass(frozen=True, kw_only=True)
class Term:
    """An effect or process in the model, with shape, times and prior.

    ``columns`` of a frame (n, k): acceleration [m/s^2] per unit of each of its k amplitudes. Their prior is N(0,
    ``sd``^2), restricted to positive values if ``positive``. An amplitude with a modulus above ``max_size``, or itself
    above ``max_positive_size``, is impossible. ``cost`` [nats]: minus the log prior probability of its times, or of a
    swing's period. ``is_noisy``: its columns contain noise of the measured force. ``is_slope``: it is part of the road.
    """

    name: str
    columns: Columns
    sd: float
    positive: bool = False
    max_size: float = np.inf
    max_positive_size: float = np.inf
    cost: float = 0.0
    is_noisy: bool = False
    is_slope: bool = False
    effect_term: EffectTerm | None = None  # None: it is no effect of the catalogue
    spans: Spans | None = None  # when it acts; None: always, or as its columns define

    @property
    def kind(self) -> Kind:
        """Category of the term in the answer."""
        if self.effect_term is not None:
            return Kind.EFFECT
        return Kind.ROAD if self.is_slope else Kind.PROCESS

    @property
    def is_timed(self) -> bool:
        """True if its times were fitted: it acts neither always nor from a standstill on."""
        return self.spans is not None and (
            self.effect_term is None or self.effect_term.effect.timing is not Timing.STEP
        )


def untimed_terms(frame: Frame, effect: Effect, quantities: frozenset[Quantity]) -> list[Term]:
    """All terms of an effect that need no fitted times: with its shapes, or from standstills that it may begin at.

    ``quantities`` are those that the drive carries.
    """
    shapes = effect.usable_shapes(quantities)
    effect_terms = [
        EffectTerm(effect, shape) for shape in shapes if effect.timing is Timing.ALWAYS or shape is not None
    ]
    if effect.timing is Timing.STEP:
        effect_terms = [EffectTerm(effect, None, spans) for spans in _from_standstills(frame.strides)]
    return [term_of(frame, effect_term) for effect_term in effect_terms]


def term_of(frame: Frame, effect_term: EffectTerm, cost: float = 0.0) -> Term:
    """Term of an effect of the catalogue, with its shape and times; ``cost`` [nats] of these."""
    effect = effect_term.effect
    return Term(
        name=effect.name,
        columns=lambda frame: frame.column(effect_term)[:, None],
        sd=effect.usual_magnitude(frame.road_load),
        positive=effect.positive,
        max_size=effect.limit(frame.road_load),
        max_positive_size=effect.max_positive_size,
        cost=cost,
        is_noisy=effect.is_noisy,
        effect_term=effect_term,
        spans=effect_term.spans,
    )


def as_effect_terms(frame: Frame, process: Term) -> list[EffectTerm]:
    """Columns of a process or of stretches as single terms of a fit, each with the prior of its amplitude."""
    power = _Powers(frame, process)
    return [EffectTerm(_of_process(process, power, k), usual_sds=1.0) for k in range(power.count)]


class _Powers:
    """Power [W] (n, k) of a process for the force of a view of the frame's strides; the last view is cached."""

    def __init__(self, frame: Frame, process: Term) -> None:
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


def _of_process(process: Term, power: _Powers, k: int) -> Effect:
    """Effect whose power is column ``k`` of a process."""
    return Effect(
        name=process.name,
        equation="",
        source="",
        symbol="",
        unit="1",
        power=lambda view, shape: power(view)[:, k],
        usual_magnitude=lambda road_load: process.sd,
        positive=False,
        is_noisy=True,  # otherwise its columns would be asked for at other strides than the frame's
        is_gravity=process.is_slope,
    )


def _from_standstills(strides: Strides) -> Iterator[Spans]:
    """Spans from each standstill to the end of the drive, with more than 5 % of the strides on either side."""
    stops = strides.context.get(Quantity.STOPS, np.zeros(len(strides)))
    for k in range(1, int(np.nanmax(stops, initial=0)) + 1):
        after = stops >= k
        if 0.05 < after.mean() < 0.95:
            yield ((float(strides.t[np.argmax(after)]) - DURATION / 2, float(strides.t[-1]) + DURATION / 2),)
