"""Components of a drive: effects and processes beside the road load and the road, each a set of columns with a prior.

An effect of the catalogue has one column, its power per unit of magnitude. A nameless process has many: hat functions
along an axis, times what it is proportional to, all with the same prior. So both are judged by the same likelihood.

In the equation of motion a power h comes as the acceleration -h / (m v). Columns that hold the acceleration take the
one that the force gives the vehicle on level ground, (F - A - C v^2) / m: the measured one has the road in it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.model.design_matrix import Spans, Term
from estimator.model.effects.effect import Effect, Timing, View
from estimator.signals import Floats, Quantity
from estimator.strides import Strides

TIMES = (120.0, 480.0, 1920.0)  # s, distances of hats in time: shorter ones cannot be separated from slopes
SPEEDS = (3.0,)  # m/s
ENGINE_SPEEDS = (15.0,)  # rad/s
STRENGTHS = (0.1, 0.3, 1.0)  # of what is usual
GAIN_ERROR = 0.1  # share of the force, usual where a gain wanders


@dataclass(frozen=True)
class Frame:
    """The strides of a drive and an estimate of the vehicle, from which columns are computed."""

    strides: Strides  # those whose force is known
    force: Floats  # (n,) [N] at the lag of the drive
    road_load: Floats  # [A, C, m]

    @classmethod
    def of(cls, fit: RoadFit) -> "Frame":
        """From a fit of the road model."""
        return cls(fit.strides, fit.strides.force[:, fit.scales.lag], np.maximum(fit.theta[:3], 1e-9))

    def disturbed(self, error: Floats) -> "Frame":
        """With an error [N] (n,) in the measured force."""
        return replace(self, force=self.force + error)

    @property
    def view(self) -> View:
        """The quantities that effects are computed from, with the acceleration on level ground."""
        s = self.strides
        A, C, m = self.road_load.tolist()
        density = s.relative_density
        felt = (self.force - A - C * density * s.speed_squared) / m
        level = np.zeros(len(s))
        return View(
            t=s.t,
            v=s.speed,
            a=felt,
            P=self.force * s.speed,
            density=density,
            context=s.context,
            road_load=self.road_load,
            climb=level,
        )

    def column(self, term: Term) -> Floats:
        """Acceleration [m/s^2] (n,) per unit of a term's magnitude."""
        return self.as_acceleration(term.column(self.view))

    def as_acceleration(self, power: Floats) -> Floats:
        """Acceleration [m/s^2] (n, ...) lost by a power [W] (n, ...)."""
        taken: Floats = -(power.T / (self.strides.speed * self.road_load[2])).T
        return taken


Columns = Callable[[Frame], Floats]


@dataclass(frozen=True, kw_only=True)
class Component:
    """One form that a component may take.

    ``columns`` of a frame (n, k): acceleration [m/s^2] per unit of each of its k amplitudes, whose prior is
    N(0, ``sd``^2), or half of it where ``positive``. ``cost`` is the log prior probability of its times, with the sign
    changed. ``is_noisy``: noise of the measured force is in its columns.
    """

    name: str
    columns: Columns
    sd: float
    positive: bool = False
    cost: float = 0.0
    is_noisy: bool = False
    term: Term | None = None  # None: a nameless process


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
        cost=cost,
        is_noisy=effect.is_noisy,
        term=term,
    )


def _from_standstills(strides: Strides) -> Iterator[Spans]:
    """From each standstill to the end of the drive, where enough was driven on both sides."""
    stops = strides.context.get(Quantity.STOPS, np.zeros(len(strides)))
    for k in range(1, int(np.nanmax(stops, initial=0)) + 1):
        after = stops >= k
        if 0.05 < after.mean() < 0.95:
            yield ((float(strides.t[np.argmax(after)]), float(strides.t[-1])),)


def processes(frame: Frame) -> Iterator[Component]:
    """All nameless processes, in all their lengths and strengths."""
    A, C, m = frame.road_load.tolist()
    s = frame.strides
    over = [
        ("power over time", _power, 0.3 * m, s.t, TIMES),  # 8 kW for a truck of 27 t
        ("force over time", _force, 0.3 * A, s.t, TIMES),
        ("drag over time", _drag, 0.3 * C, s.t, TIMES),
        ("gain over time", _measured, GAIN_ERROR, s.t, TIMES),
        ("force over speed", _force, 0.3 * A, s.speed, SPEEDS),
    ]
    turns = s.context.get(Quantity.ENGINE_SPEED)
    if turns is not None and np.isfinite(turns).all():
        over.append(("power over engine speed", _power, 0.3 * m, turns, ENGINE_SPEEDS))
    for name, profile, usual, axis, lengths in over:
        for length in lengths:
            columns = _along(profile, hats(axis, length))
            for strength in STRENGTHS:
                yield Component(name=name, columns=columns, sd=strength * usual, is_noisy=profile is _measured)


def _power(frame: Frame) -> Floats:
    return np.ones(len(frame.strides))


def _force(frame: Frame) -> Floats:
    return frame.strides.speed


def _drag(frame: Frame) -> Floats:
    return frame.strides.speed**3


def _measured(frame: Frame) -> Floats:
    return frame.force * frame.strides.speed


def _along(profile: Callable[[Frame], Floats], shapes: Floats) -> Columns:
    return lambda frame: frame.as_acceleration(shapes * profile(frame)[:, None])


def hats(axis: Floats, spacing: float) -> Floats:
    """Hat functions (n, k) with peaks every ``spacing`` along ``axis`` (n,): they sum to one everywhere."""
    place = (axis - axis.min()) / spacing
    peaks = np.arange(int(np.ceil(place.max())) + 1)
    found: Floats = np.maximum(1 - np.abs(place[:, None] - peaks), 0.0)
    return found[:, found.any(axis=0)]
