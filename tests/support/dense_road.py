"""Strides, and the covariance of the road model under them written out with dense matrices."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from estimator.estimation.road_likelihood import Likelihood
from estimator.model.matern import MaternField
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import HEIGHT_SD, LEVEL, MAX_PASSAGE, ROUGH, SMOOTH, START_HEIGHT_SD, RoadModel
from estimator.model.road_nodes import SIGNALS, Nodes
from estimator.model.road_scales import SCALES
from estimator.signals import Floats, Mask
from estimator.strides import DURATION, LAGS, Strides
from estimator.units import STANDARD_GRAVITY

M, A, C = 20_000.0, 1500.0, 3.5
MIDDLE = len(LAGS) // 2
ORDERS = [(2, ROUGH), (4, ROUGH), (2, SMOOTH), (LEVEL, ROUGH), (LEVEL, SMOOTH)]  # of the road and of the wander
SHOWN = [(), ("altitude",), ("grade",), ("gravity",), SIGNALS]


def strides_of(
    n: int = 40,
    seed: int = 0,
    shown: Iterable[str] = (),
    unknown: Iterable[int] = (11, 12, 25),
    silence: int = 20,
    gap: float = 5e4,
    force: Floats | None = None,
) -> Strides:
    """A drive of ``n`` strides with some whose force is not known, and another road after stride ``silence``."""
    rng = np.random.default_rng(seed)
    v = np.clip(15 + np.cumsum(rng.normal(0, 0.6, n + 1)), 6, 25)
    steps = 0.5 * (v[1:] + v[:-1])
    s0 = np.concatenate([[0.0], np.cumsum(steps)[:-1]]) + np.where(np.arange(n) >= silence, gap, 0.0)
    t = np.arange(n) + 0.6 + np.where(np.arange(n) >= silence, 100.0, 0.0)
    known = np.ones(n, bool)
    known[list(unknown)] = False
    if force is None:
        force = np.cumsum(rng.normal(0, 3000, n)) * 0.5 + 2000
    blank = np.full(n, np.nan)
    signals = {name: rng.normal(0, 0.02, n) * (1 + 99 * (name == "altitude")) for name in shown}
    return Strides(
        t=t,
        rows=np.full(n, 10),
        known=known,
        v0=v[:-1],
        v1=v[1:],
        s0=s0,
        s1=s0 + steps,
        a=rng.normal(0, 0.3, n),
        speed_squared=steps**2,
        force=np.column_stack([force + 50 * i * rng.normal(0, 1, n) for i in range(-MIDDLE, MIDDLE + 1)]),
        gearing=rng.uniform(5, 20, n),
        density=rng.uniform(1.1, 1.3, n),
        altitude=signals.get("altitude", blank),
        grade=signals.get("grade", blank),
        grade_offset_sd=blank,
        gravity=signals.get("gravity", blank),
    )


def scales_of(model: RoadModel, seed: int = 0, **changes: float) -> Floats:
    """Scales around the centres of their priors."""
    rng = np.random.default_rng(seed)
    values = {scale.name: scale.centre * rng.uniform(0.6, 1.6) for scale in model.scales}
    return np.array(list((values | {name.replace("_", " "): value for name, value in changes.items()}).values()))


def dense_field(nodes: Nodes, alpha: int, sd: float, length: float) -> Floats:
    n = len(nodes.s)
    if alpha == LEVEL:
        return np.zeros((n, n))
    target = np.zeros((alpha + 1, n))
    MaternField(nodes.s, nodes.joined, alpha, np.arange(n), target.shape).add_precision(target, sd, length)
    Q = sum(np.diag(target[d, : n - d], -d) for d in range(min(alpha + 1, n)))
    return np.linalg.inv(Q + np.tril(Q, -1).T)


def ou(t: Floats, other: Floats, time: float) -> Floats:
    correlation: Floats = np.exp(-np.abs(t[:, None] - other) / time)
    return correlation


def wandering(model: RoadModel, sd: float, memory: float) -> Floats:
    t = model.nodes.t
    if model.wander == ROUGH:
        return sd**2 * ou(t, t, memory)
    return dense_field(replace(model.nodes, s=t, joined=np.insert(np.diff(t) <= MAX_PASSAGE, 0, False)), 2, sd, memory)


class Dense:
    """Covariance of motion and readings, part by part, as the module's docstring has it."""

    def __init__(self, model: RoadModel, scales: Floats) -> None:
        torque, time, speed, disturbance, sd, length, power, memory = scales[:8]
        driven, nodes = model.strides[model.strides.known], model.nodes
        n = len(driven)
        before, after = driven.t - DURATION / 2, driven.t + DURATION / 2
        run = np.cumsum(~model.strides.joined[model.strides.known])
        together = run[:, None] == run
        # Errors of the speeds: the end of one stride is the beginning of the next one that is joined.
        same = (np.abs(after[:, None] - before) < 1e-6) & together
        K = speed**2 / DURATION**2 * (2 * np.eye(n) - same - same.T)
        # Error of the force.
        share, own = mean_given_ends(DURATION, time)
        ends = [before, after]
        covariance = sum(ou(one, other, time) for one in ends for other in ends) * together
        weight = driven.gearing / np.median(driven.gearing)
        self.force = torque**2 * np.outer(weight, weight) * (share**2 * covariance + own * np.eye(n))
        self.sensors = K + torque**2 * np.outer(weight, weight) * share**2 * covariance  # but for their white part
        rate = ou(after, after, time) + ou(before, before, time) - ou(after, before, time) - ou(before, after, time)
        self.rate = torque**2 * np.outer(weight, weight) * rate * together / DURATION**2
        cross = sum(ou(one, after, time) - ou(one, before, time) for one in ends) * together
        self.force_with_rate = torque**2 * np.outer(weight, weight) * share * cross / DURATION
        K = K + self.force + disturbance**2 * np.eye(n)
        # Power that no signal shows.
        share, own = mean_given_ends(DURATION, memory)
        covariance = sum(ou(one, other, memory) for one in ends for other in ends) * together
        slowness = np.median(driven.speed) / driven.speed
        K = K + power**2 * np.outer(slowness, slowness) * (share**2 * covariance + own * np.eye(n))
        self.sensors = self.sensors + power**2 * np.outer(slowness, slowness) * share**2 * covariance
        # The road, looked up at five points of a stride.
        theta = dense_field(replace(nodes, s=model.along), model.alpha, sd, length)
        identity = np.eye(len(nodes.s))

        def at(s: Floats) -> Floats:
            return np.array([np.interp(s, nodes.s, row) for row in identity]).T

        points = zip((0.1, 0.3, 0.5, 0.7, 0.9), (0.08, 0.25, 0.34, 0.25, 0.08), strict=True)
        self.hats = sum(w * at(driven.s0 + p * (driven.s1 - driven.s0)) for p, w in points)
        # Height above the beginning of each stretch, by the trapezoid rule.
        k = len(nodes.s)
        D, W = np.eye(k), np.zeros((k, k))
        for node in np.flatnonzero(nodes.joined):
            D[node, node - 1] = -1
            W[node, [node - 1, node]] = 0.5 * (nodes.s[node] - nodes.s[node - 1])
        rise = np.linalg.solve(D, W)
        loose = (
            np.linalg.inv(D) @ np.diag(np.where(nodes.joined, HEIGHT_SD**2, START_HEIGHT_SD**2)) @ np.linalg.inv(D).T
        )
        maps, noises, values = [-STANDARD_GRAVITY * self.hats], [K], []
        for i, name in enumerate(model.reading_names):
            noise, wander, memory = scales[len(SCALES) + 3 * i : len(SCALES) + 3 * i + 3]
            heard = model.strides[np.isfinite(getattr(model.strides, name))]
            middle = 0.5 * (heard.s0 + heard.s1)
            nearest = np.array([int(np.argmin(np.abs(nodes.s - s) - 1e-9 * nodes.s)) for s in middle])
            places, counts = np.unique(nearest, return_counts=True)
            told = getattr(heard, name) / (STANDARD_GRAVITY if name == "gravity" else 1.0)
            mean = np.array([told[nearest == place].mean() for place in places])
            squares = np.array([(heard.speed[nearest == place] ** 2).mean() for place in places])
            bends = 3.0 / STANDARD_GRAVITY / squares if name == "gravity" else np.zeros(len(places))
            R = np.diag(noise**2 / np.minimum(counts, 10) + bends**2)
            R = R + wandering(model, wander, memory)[np.ix_(places, places)]
            if name == "altitude":
                maps.append(rise[places])
                R = R + loose[np.ix_(places, places)]
                mean = mean - mean[0]
            else:
                maps.append(identity[places])
            noises.append(R)
            values.append(mean)
        B = np.vstack(maps)
        self.of_slopes = B @ theta @ B.T
        total = self.of_slopes.copy()
        at_row = 0
        for noise in noises:
            part = slice(at_row, at_row + len(noise))
            total[part, part] += noise
            at_row += len(noise)
        self.K, self.readings = total, np.concatenate(values) if values else np.empty(0)


def observed(model: RoadModel) -> Mask:
    """Which rows of the data are motion or readings: height's links and starts are constraints."""
    links = len(model.nodes.s) if model.has_altitude else 0
    keep = np.ones(sum(model.counts), bool)
    keep[len(model.driven) : len(model.driven) + links] = False
    return keep


def likelihood_of(strides: Strides, alpha: int = 2, wander: int = ROUGH) -> Likelihood:
    return Likelihood(RoadModel(strides, alpha, wander), (), np.array([A, C, M]), MIDDLE)
