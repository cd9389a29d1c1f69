"""Columns of the model for given samples: the plain road load, the lag, and effects beyond them.

X = [v, v^3, v a, -dP, h1, h2, ...] for theta = [A, C, m, tau, b1, b2, ...], and the instruments Z likewise. An effect
whose magnitude is the mass itself adds to the column of m instead.
"""

from collections.abc import Set
from dataclasses import KW_ONLY, dataclass, replace
from itertools import pairwise

import numpy as np

from estimator.model.effects import Effect, Shape, View
from estimator.model.effects.effect import AtRest
from estimator.model.road_load import design
from estimator.samples import Samples
from estimator.signals import Floats, Quantity
from estimator.units import STANDARD_GRAVITY

PLAIN = 4  # columns without effects
MASS = 2  # of the mass
LAG = 3  # of the lag of power
MIN_ROLLING, MIN_DRAG = 0.002, 2e-5  # coefficient of rolling [1] and C over mass [1/m], below those of any vehicle
USUAL_SDS = 3.0  # prior sd of the magnitude of an effect that is given, in usual magnitudes
MAX_MASS_DIFFERENCE = 0.1  # share of the mass, between the mass by inertia and by gravity
Span = tuple[float, float]
Spans = tuple[Span, ...]


@dataclass(frozen=True)
class Term:
    """An effect as it is in the model: its shape, and when it acts, from and to [s], None for always.

    ``usual_sds``: prior sd of its magnitude, in usual magnitudes.
    """

    effect: Effect
    shape: Shape = None
    spans: Spans | None = None
    _: KW_ONLY
    joins_mass: bool = False  # its magnitude is the mass itself, not a parameter of its own
    usual_sds: float = USUAL_SDS

    def column(self, view: View) -> Floats:
        """Power [W] (n,) per unit of magnitude."""
        power = self.effect.power(view, self.shape)
        return power if self.spans is None else power * covered(view.t, view.duration, self.spans)

    def prior_sd(self, road_load: Floats) -> float:
        """Of its magnitude, for a vehicle with ``road_load`` = [A, C, m] (3,)."""
        return self.usual_sds * self.effect.usual(road_load)

    def at_rest(self, rest: AtRest) -> float:
        """Power [W] per unit of magnitude that it takes while the vehicle stands."""
        return 0.0 if self.effect.at_rest is None else self.effect.at_rest(rest, self.shape)


def inside(t: Floats, spans: Spans) -> Floats:
    """1 for each time [s] (n,) within one of the spans, 0 elsewhere."""
    edges = np.array(spans).reshape(-1, 2)
    begun, ended = np.searchsorted(edges[:, 0], t, side="right"), np.searchsorted(edges[:, 1], t, side="left")
    within: Floats = (begun > ended).astype(float)
    return within


def covered(t: Floats, duration: float | Floats, spans: Spans) -> Floats:
    """Share (n,) of the ``duration`` [s], one or (n,), around each time ``t`` [s] (n,) that lies within ``spans``."""
    if not np.any(duration):
        return inside(t, spans)
    edges = np.array(spans).reshape(-1, 2)
    if not edges.size:
        return np.zeros(len(t))
    within = np.cumsum(np.column_stack([np.zeros(len(edges)), edges[:, 1] - edges[:, 0]]))  # of the time up to an edge
    before, after = (np.interp(t + half, edges.ravel(), within) for half in (-duration / 2, duration / 2))
    share: Floats = (after - before) / duration
    return share


def union(one: Spans, other: Spans) -> Spans:
    """Times that are within either."""
    joined: list[tuple[float, float]] = []
    for start, end in sorted((*one, *other)):
        if joined and start <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return tuple(joined)


def cut(one: Spans, other: Spans) -> Spans:
    """Times that are within either, cut wherever a span of either begins or ends."""
    edges = sorted({edge for span in (*one, *other) for edge in span})
    within = union(one, other)
    return tuple((a, b) for a, b in pairwise(edges) if any(start <= a and b <= end for start, end in within))


def without(one: Spans, other: Spans) -> Spans:
    """Times that are within ``one`` and not within the other."""
    left: list[tuple[float, float]] = []
    for start, end in one:
        for other_start, other_end in sorted(other):
            if start < other_end and other_start < end:
                left += [(start, other_start)] if start < other_start else []
                start = max(start, other_end)
        left += [(start, end)] if start < end else []
    return tuple(left)


def views(samples: Samples, road_load: Floats, terms: tuple[Term, ...] = ()) -> tuple[View, View]:
    """``samples`` as measured, and with the quantities of their instruments.

    Some effects scale with ``road_load`` = [A, C, m] (3,), and with the climb by a signal among ``terms``.
    """
    density, context = samples.relative_density, samples.context
    # An effect missing in the model can make A or C negative; effects proportional to them need a positive scale.
    m = max(float(road_load[MASS]), 0.0)
    road_load = np.maximum(road_load, np.array([MIN_ROLLING * STANDARD_GRAVITY, MIN_DRAG, 1.0]) * m)
    gravity = [context[term.shape] for term in terms if term.effect.is_gravity]
    climb = gravity[0] if gravity else np.zeros(len(samples))
    own = View(
        t=samples.t,
        v=samples.v,
        a=samples.a,
        P=samples.P,
        density=density,
        context=context,
        road_load=road_load,
        climb=climb,
    )
    # Model power, not measured power: a missing effect is correlated over more than the instrument's window of
    # readings, so it would be in the measured power of the sample and of its instrument, and bias both.
    around = design(samples.zv, samples.za, density) @ road_load
    return own, replace(own, v=samples.zv, a=samples.za, P=around)


def columns(samples: Samples, terms: tuple[Term, ...] = (), road_load: Floats | None = None) -> tuple[Floats, Floats]:
    """Regressors X and instruments Z, both (n, 4 + own parameters of the terms)."""
    density = samples.relative_density
    X = np.column_stack([design(samples.v, samples.a, density), -samples.dP])
    Z = np.column_stack([design(samples.zv, samples.za, density), -samples.zdP])
    if not terms:
        return X, Z
    own, ring = views(samples, np.zeros(3) if road_load is None else road_load, terms)
    for term in terms:
        x, z = term.column(own), term.column(ring)
        if term.joins_mass:
            X[:, MASS] += x
            Z[:, MASS] += z
        else:
            X, Z = np.column_stack([X, x]), np.column_stack([Z, z])
    return X, Z


def settled(term: Term, samples: Samples) -> Term:
    """The term as it enters the model: gravity joins the mass if the mass by inertia and by gravity agree.

    They differ where the signal of the climb is noisy: the noise adds slopes that take no power, so that the mass by
    gravity is too small.
    """
    if not term.effect.is_gravity:
        return term
    X, Z = columns(samples, (term,))
    if not X[:, PLAIN].any():  # on a flat road the column is zero, and its coefficient is undefined
        return replace(term, joins_mass=True)
    theta = np.linalg.lstsq(Z.T @ X, Z.T @ samples.P, rcond=None)[0]
    return replace(term, joins_mass=bool(abs(theta[PLAIN] - theta[MASS]) < MAX_MASS_DIFFERENCE * abs(theta[MASS])))


def wanted_by(effects: tuple[Effect, ...], known: Set[Quantity]) -> frozenset[Quantity]:
    """The context, of that which is ``known``, that these effects are computed from."""
    if not effects:
        return frozenset()
    shapes = {
        shape for effect in effects for shape in effect.streaming_shapes(known)[:1] if isinstance(shape, Quantity)
    }
    needs = {need for effect in effects for need in effect.needs}
    return frozenset(shapes | needs) & known


def best_terms(effects: tuple[Effect, ...], samples: Samples, road_load: Floats) -> tuple[Term, ...]:
    """Each effect with the shape, of those that can be computed, that explains most beside the plain road load.

    ``road_load`` = [A, C, m] (3,) scales the effects.
    """
    known = frozenset(samples.context)
    X, Z = columns(samples)
    project = np.linalg.pinv(Z.T @ X)
    residual = samples.P - X @ (project @ (Z.T @ samples.P))
    _, ring = views(samples, road_load)
    found = []
    for effect in effects:
        shapes = effect.streaming_shapes(known)
        if len(shapes) > 1 and not isinstance(shapes[0], Quantity):
            z = np.column_stack([effect.power(ring, shape) for shape in shapes])
            off = z - Z @ (project.T @ (X.T @ z))
            slope = off.T @ residual
            gain = np.where((slope > 0) | (not effect.positive), slope**2 / np.maximum((off**2).sum(axis=0), 1e-12), 0)
            shapes = (shapes[int(np.argmax(gain))],)
        found += [settled(Term(effect, shape), samples) for shape in shapes[:1]]
    return tuple(found)
