"""The filter of the road against the same Gaussian written out with dense matrices, and against the banded fit."""

from dataclasses import replace

import numpy as np
import pytest
from dense_road import MIDDLE, SHOWN, A, C, M, ou, scales_of, strides_of
from numpy.testing import assert_allclose
from scipy.special import gamma, kv

from estimator.estimation.road_filter import RoadFilter
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood, columns
from estimator.estimation.scales import RoadScales
from estimator.model.conditioned import Conditioned
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import ROUGH, SMOOTH, START_HEIGHT_SD, RoadModel
from estimator.model.road_nodes import BEND, SPACING, warping
from estimator.model.road_scales import SCALES
from estimator.signals import Floats
from estimator.strides import DURATION, Strides
from estimator.units import STANDARD_GRAVITY

OFFSETS = {"altitude": 0, "grade": 1, "gravity": 1}
BETA = np.array([1 / M, A / M, C / M, 0.05 / M, 0.0])


def fit_of(strides: Strides, alpha: int, wander: int, power: bool = True, designed: bool = False, seed: int = 3):
    """A fit with made scales, coefficients and doubt."""
    model = RoadModel(strides, alpha, wander, power, designed)
    offsets = [0.002 * (i + 1) for i in range(sum(OFFSETS[name] for name in model.reading_names))]
    beta = np.array([*BETA, *offsets])
    root = np.random.default_rng(seed).normal(size=(len(beta), len(beta))) * np.abs(np.where(beta, beta, 1e-6)) * 0.02
    values = scales_of(model, seed)
    if not power:
        values[6] = SCALES[6].low
    scales = RoadScales(
        values=values,
        point=model.references.point,
        alpha=alpha,
        wander=wander,
        readings=model.reading_names,
        lag=MIDDLE,
        designed=designed,
    )
    return RoadFit(
        beta=beta,
        covariance=root.T @ root,
        scales=scales,
        log_evidence=0.0,
        terms=(),
        strides=model.driven,
        references=model.references,
        fitted=np.zeros(0),
        slope=np.zeros(0),
        slope_sd=0.01,
        slope_doubt=0.0,
        climbed=0.0,
        equations=None,  # type: ignore[arg-type]  # of no use here
    )


def matern(x: Floats, y: Floats, alpha: int, length: float) -> Floats:
    nu, u = alpha - 0.5, np.abs(x[:, None] - y) * np.sqrt(2 * alpha - 1) / length
    u = np.where(u > 0, u, 1.0)
    correlation = 2 ** (1 - nu) / gamma(nu) * u**nu * kv(nu, u)
    return np.where(x[:, None] == y, 1.0, correlation)


def at_the_last(strides: Strides, fit: RoadFit) -> tuple[float, float, float]:
    """Slope under the last stride, its sd without and with the doubt of the coefficients: dense, on one road."""
    torque, time, speed, disturbance, sd, length, power, memory = fit.scales.values[:8]
    driven, middle, n = strides[strides.known], 0.5 * (strides.s0 + strides.s1), len(strides)
    before, after = driven.t - DURATION / 2, driven.t + DURATION / 2
    run = np.cumsum(~strides.joined[strides.known])
    together = run[:, None] == run
    same = (np.abs(after[:, None] - before) < 1e-6) & together
    K = speed**2 / DURATION**2 * (2 * np.eye(len(driven)) - same - same.T) + disturbance**2 * np.eye(len(driven))
    gearing = driven.gearing / np.median(driven.gearing)
    noises = [(torque, time, gearing)]
    noises += [(power, memory, np.median(driven.speed) / driven.speed)] if fit.scales.has_power else []
    for size, lasting, share in noises:
        weight, own = mean_given_ends(DURATION, lasting)
        ends = sum(ou(one, other, lasting) for one in (before, after) for other in (before, after)) * together
        K = K + size**2 * np.outer(share, share) * (weight**2 * ends + own * np.eye(len(driven)))
    factor = warping((strides.s1 - strides.s0) / DURATION) if fit.scales.designed else np.ones(n)
    along = np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1]) * np.diff(middle))])
    theta = sd**2 * matern(along, along, fit.scales.alpha, length)
    rise = np.zeros((n, n))
    for i in range(1, n):
        rise[i] = rise[i - 1]
        rise[i, [i - 1, i]] += 0.5 * (middle[i] - middle[i - 1])
    maps, blocks, data = [-STANDARD_GRAVITY * np.eye(n)[strides.known]], [K], [driven.a]
    X = [columns(driven, MIDDLE, (), np.array([A, C, M]))]
    at = X[0].shape[1]
    X[0] = np.pad(X[0], ((0, 0), (0, len(fit.beta) - at)))
    for i, name in enumerate(fit.scales.readings):
        noise, size, lasting = fit.scales.values[len(SCALES) + 3 * i :][:3]
        values = getattr(strides, name) / (STANDARD_GRAVITY if name == "gravity" else 1.0)
        R = noise**2 * np.eye(n)
        if name == "gravity":
            near = np.maximum(SPACING / (strides.s1 - strides.s0), 1.0)
            R += np.diag(near * (BEND / strides.speed**2) ** 2)
        if fit.scales.wander == ROUGH:
            R += size**2 * ou(strides.t, strides.t, lasting)
        else:
            R += size**2 * matern(strides.t, strides.t, 2, lasting)
        if name == "altitude":
            values, R = values - values.mean(), R + START_HEIGHT_SD**2
        shape = np.zeros((n, len(fit.beta)))
        if OFFSETS[name]:
            shape[:, at] = 1.0
            at += 1
        maps.append(rise if name == "altitude" else np.eye(n))
        blocks.append(R)
        data.append(values)
        X.append(shape)
    B, Y, X = np.vstack(maps), np.concatenate(data), np.vstack(X)
    total, at = B @ theta @ B.T, 0
    for block in blocks:
        total[at : at + len(block), at : at + len(block)] += block
        at += len(block)
    gain = np.linalg.solve(total, B @ theta[:, -1])
    own = theta[-1, -1] - gain @ (B @ theta[:, -1])
    doubt = gain @ X @ fit.covariance @ X.T @ gain
    return float(gain @ (Y - X @ fit.beta)), float(np.sqrt(own)), float(np.sqrt(own + doubt))


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(("alpha", "wander"), [(2, ROUGH), (4, ROUGH), (2, SMOOTH)])
@pytest.mark.parametrize(("power", "designed"), [(True, False), (False, True)])
def test_slope_and_its_doubt_are_those_of_the_dense_gaussian(shown, alpha, wander, power, designed):
    strides = strides_of(shown=shown, gap=0.0, silence=99)
    fit = fit_of(strides, alpha, wander, power, designed)
    mean, own, both = at_the_last(strides, fit)
    belief = RoadFilter(fit, strides).belief()
    assert belief.t == strides.t[-1]
    assert belief.mean[0] == pytest.approx(mean, abs=1e-6 * both)
    assert np.sqrt(belief.covariance[0, 0]) == pytest.approx(both, rel=1e-6)
    certain = RoadFilter(replace(fit, covariance=0 * fit.covariance), strides).belief()
    assert np.sqrt(certain.covariance[0, 0]) == pytest.approx(own, rel=1e-6)


def test_strides_may_come_one_by_one():
    strides = strides_of(shown=("altitude", "grade"))
    fit = fit_of(strides, 2, ROUGH)
    whole, parts = RoadFilter(fit, strides), RoadFilter(fit, strides, begin=len(strides))
    for i in range(len(strides)):
        parts.follow(strides[i : i + 1])
    assert_allclose(parts.belief().mean, whole.belief().mean, rtol=1e-9)
    assert_allclose(parts.belief().covariance, whole.belief().covariance, rtol=1e-9)
    assert_allclose(parts.heights, whole.heights, rtol=1e-9)


@pytest.mark.parametrize("shown", [(), ("grade",)], ids="+".join)
def test_behind_a_gap_the_road_is_another_one(shown):
    strides = strides_of(shown=shown)
    fit = fit_of(strides, 2, ROUGH)
    at = 20  # the first stride behind the gap
    known = RoadFilter(fit, strides[:at])
    assert known.heights[-1][2] < 10.0 < 900.0 < RoadFilter(fit, strides[: at + 1]).heights[-1][2]


def test_ahead_the_slope_becomes_that_of_any_road():
    strides = strides_of()
    fit = fit_of(strides, 2, ROUGH)
    belief = RoadFilter(fit, strides).belief()
    sds = [np.sqrt(belief.ahead(metres).covariance[0, 0]) for metres in (0.0, 50.0, 200.0, 1e5)]
    assert sds == sorted(sds)
    assert sds[0] == np.sqrt(belief.covariance[0, 0])
    assert sds[-1] == pytest.approx(fit.scales.values[4], rel=1e-6)
    assert belief.ahead(1e5).mean[0] == pytest.approx(0.0, abs=1e-9)


def test_it_agrees_with_the_fit_where_the_road_goes_on():
    """The fit joins nodes 25 m apart by straight lines: up to 0.002 % of slope and 0.08 sd on twelve such drives."""
    strides = made_drive()
    fit = fit_of(strides, 2, ROUGH, power=False)
    for n in (120, 200, len(strides)):
        part = strides[:n]
        belief = RoadFilter(replace(fit, covariance=0 * fit.covariance), part).belief()
        mean = banded(part, fit)
        assert belief.mean[0] == pytest.approx(mean, abs=0.1 * np.sqrt(belief.covariance[0, 0]))


def made_drive(n: int = 300, seed: int = 5) -> Strides:
    """Strides over a road of the model, whose force keeps the speed."""
    rng = np.random.default_rng(seed)
    plain = strides_of(n, seed, unknown=(), gap=0.0, silence=n + 1)
    middle = 0.5 * (plain.s0 + plain.s1)
    root = np.linalg.cholesky(matern(middle, middle, 2, 400.0) + 1e-9 * np.eye(n))
    slope = 0.01 * root @ rng.normal(size=n)
    X = columns(plain, MIDDLE, (), np.array([A, C, M]))
    a = X @ BETA - STANDARD_GRAVITY * slope + rng.normal(0, 0.005, n)
    return replace(plain, a=a, gearing=np.full(n, 8.0), density=np.full(n, 1.2))


def banded(strides: Strides, fit: RoadFit) -> float:
    """Slope under the last stride by the fit's own solution, on a road that goes on 1.4 km."""
    tail = strides[-1:]
    tail = replace(tail, t=tail.t + 60.0, known=np.array([False]), s0=tail.s1, s1=tail.s1 + 1400.0)
    model = fit.scales.model_of(Strides.concatenate([strides, tail]))
    likelihood = Likelihood(model, (), np.array([A, C, M]), MIDDLE)
    conditioned = Conditioned.of(model, fit.scales.values)
    residual = likelihood.data[:, 0] - likelihood.data[:, 1:] @ (fit.beta * likelihood.unit)
    return float(model.road(conditioned.unknowns(residual))[1][-1])
