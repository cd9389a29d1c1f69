"""Corrections of the normal equations, against dense matrices and against many simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
from dense_road import (
    MIDDLE,
    ORDERS,
    SHOWN,
    A,
    C,
    Dense,
    M,
    likelihood_of,
    observed,
    scales_of,
    strides_of,
)
from numpy.testing import assert_allclose

from estimator.estimation.normal_equations import (
    DRIVER_FEEDBACK,
    DRIVER_FEEDBACK_SD,
    MAX_DRIVER_CORRECTION,
    NormalEquations,
    of_first_order,
)
from estimator.estimation.road_likelihood import DRAG, LAG, PARTS, ROAD_LOAD, Likelihood, shapes_of
from estimator.model.conditioned import Conditioned
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import LEVEL, RoadModel
from estimator.model.road_scales import TORQUE
from estimator.strides import DURATION


def equations_of(likelihood, scales, shapes=None, chance=0.0):
    n = len(likelihood.model.driven)
    shapes = np.empty((n, 0)) if shapes is None else shapes
    return NormalEquations.of(likelihood, scales, range(len(scales)), chance, shapes)


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(("alpha", "wander"), ORDERS)
def test_the_freedom_of_the_slopes_is_that_of_the_dense_covariance(shown, alpha, wander):
    model = RoadModel(strides_of(shown=shown), alpha, wander)
    scales = scales_of(model, 3)
    dense, n = Dense(model, scales), len(model.driven)
    moved = np.zeros_like(dense.of_slopes)
    moved[:, :n] = dense.of_slopes[:, :n]  # what is in the accelerations; readings show the same slopes
    expected = np.diag(np.linalg.solve(dense.K, moved))[:n]
    found = Conditioned.of(model, scales).leverage
    assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    assert (found.sum() > 1) == (alpha != LEVEL)


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize("alpha", [2, 4])
def test_the_variance_of_the_slopes_is_that_of_many_draws(shown, alpha):
    model = RoadModel(strides_of(shown=shown), alpha)
    conditioned = Conditioned.of(model, scales_of(model, 3))
    nothing = np.zeros((sum(model.counts), 4000))
    unknowns = conditioned.draws(nothing, np.random.default_rng(1))
    drawn = np.array([model.road(each)[0] for each in unknowns.T])
    assert_allclose(conditioned.slope_variance, drawn.var(axis=0), rtol=0.15)


def test_without_noise_and_answers_they_are_solved_as_they_stand():
    likelihood = likelihood_of(strides_of(80))
    scales = scales_of(likelihood.model)
    plain = equations_of(likelihood, scales)
    equations = replace(plain, noise=np.zeros((5, 5)), driver_bias=np.zeros(5), moved=0 * plain.moved)
    beta, information, _ = likelihood.solve(likelihood.at(scales)[1])
    found, covariance, share = equations.solve()
    assert_allclose(found, beta)
    assert_allclose(covariance, np.linalg.inv(information), rtol=1e-6)
    assert share == 0.0


def test_an_engine_that_never_drags_has_no_noise_of_its_drag():
    """Divided by the size of a column of zeros, it would be endless."""
    strides = strides_of(80)
    likelihood = likelihood_of(replace(strides, force=np.abs(strides.force) + 1.0))
    equations = equations_of(likelihood, scales_of(likelihood.model, torque_noise=0.1))
    assert likelihood.unit[DRAG] == 1.0
    assert not likelihood.data[:, 1 + DRAG].any()
    assert equations.noise[DRAG, DRAG] == 0.0 < equations.noise[0, 0]
    assert equations.solve()[0][DRAG] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("taken", "coefficient", "share"),
    [(1.0, 10.0, 1.0), (10.0, 1.0, 0.1 * MAX_DRIVER_CORRECTION), (-1.0, 2.0, 1.0), (-1.0, -2.0, 0.0)],
)
def test_what_drivers_answer_is_corrected_as_far_as_it_is_small_and_never_for_a_negative_mass(
    taken, coefficient, share
):
    assert of_first_order(taken, coefficient) == pytest.approx(share)


def test_each_change_has_the_columns_of_the_road_load_once_more():
    strides = strides_of(80)
    likelihood = likelihood_of(strides)
    model = likelihood.model
    scales, shapes = scales_of(model), shapes_of(model.driven.t > 30)
    data = likelihood.with_changes(shapes)
    conditioned = Conditioned.of(model, scales)
    equations = equations_of(likelihood, scales, shapes)
    assert_allclose(equations.gram, conditioned.gram(data))
    assert equations.present == np.count_nonzero(model.driven.t > 30)
    n, p = len(model.driven), likelihood.data.shape[1] - 1
    by_force = likelihood.by_force(shapes)
    for k in range(PARTS):
        here = slice(p + ROAD_LOAD * k, p + ROAD_LOAD * (k + 1))
        assert_allclose(data[:n, 1:][:, here], shapes[:, [k]] * data[:n, 1 : 1 + ROAD_LOAD])
        assert_allclose(by_force[:, here], shapes[:, [k]] * by_force[:, :ROAD_LOAD])
    assert_allclose(by_force[:, 0] * likelihood.unit[0], 1.0, rtol=1e-6)
    assert not by_force[:, LAG].any()


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, pytest.param(0.5, marks=pytest.mark.nightly)])
def test_a_driver_who_answers_slopes_makes_the_mass_too_large_by_what_is_corrected(share):
    """Many drives over roads of the model, with the same driving but for the answers."""
    strides = strides_of(150, unknown=(), silence=150, seed=4)
    likelihood = likelihood_of(strides)
    model = likelihood.model
    scales = scales_of(model, slope=0.01, slope_length=150.0, torque_noise=1e-4, power_noise=1e-4, speed_noise=2e-3)
    dense, rng = Dense(model, scales), np.random.default_rng(6)
    n, drives = len(strides), 200
    gravity = np.linalg.cholesky(dense.of_slopes + 1e-12 * np.eye(n)) @ rng.normal(size=(n, drives))
    noise = np.linalg.cholesky(dense.K - dense.of_slopes) @ rng.normal(size=(n, drives))
    drag = A / M + C / M * strides.relative_density * strides.speed_squared
    plain, corrected = [], []
    for pull, error in zip(gravity.T, noise.T, strict=True):  # pull = -g theta
        force = 0.3 * strides.force - share * M * pull[:, None]
        a = force[:, MIDDLE] / M - drag + pull + error
        each = Likelihood(RoadModel(replace(strides, force=force, a=a), 2), (), np.array([A, C, M]), MIDDLE)
        equations = equations_of(each, scales)
        unit = each.unit[0]
        plain.append(replace(equations, driver_bias=np.zeros(5)).solve()[0][0] / unit * M - 1)
        corrected.append(equations.solve()[0][0] / unit * M - 1)
    bias, left = np.mean(plain), np.mean(corrected)
    error = np.std(corrected) / np.sqrt(drives)
    assert bias < -8 * error
    assert left == pytest.approx((share - DRIVER_FEEDBACK) * bias / share, abs=4 * error + 0.1 * abs(bias))


def test_answers_are_in_doubt_and_limited():
    likelihood = likelihood_of(strides_of(120))
    scales = scales_of(likelihood.model, slope=0.02)
    equations = equations_of(likelihood, scales)
    without, plain, _ = replace(equations, driver_bias=0 * equations.driver_bias).solve()
    beta, covariance, _ = equations.solve()
    shift = beta - without
    assert_allclose(
        covariance - plain,
        (DRIVER_FEEDBACK_SD / DRIVER_FEEDBACK) ** 2 * np.outer(shift, shift),
        atol=1e-9 * plain.max(),
    )
    far, _, _ = replace(equations, driver_bias=1e9 * equations.driver_bias).solve()
    assert far[0] / without[0] - 1 == pytest.approx(DRIVER_FEEDBACK * MAX_DRIVER_CORRECTION)


def derivative(of, scales):
    """By the logarithms of the scales: (..., k)."""
    step = 1e-5
    ends = [[of(scales * np.exp(sign * step * unit)) for sign in (1, -1)] for unit in np.eye(len(scales))]
    return np.stack([(high - low) / (2 * step) for high, low in ends], axis=-1)


def precision_of_scales(likelihood, scales, beta):
    """The average information at the corrected coefficients (p,), by dense matrices, and the priors'."""
    model = likelihood.model
    data = likelihood.data[observed(model)]
    K = Dense(model, scales).K
    V = K + data[:, 1:] @ np.linalg.inv(likelihood.prior) @ data[:, 1:].T
    weighed = np.linalg.solve(K, data[:, 0] - data[:, 1:] @ beta)
    answers = derivative(lambda s: Dense(model, s).K @ weighed, scales)
    information = 0.5 * answers.T @ np.linalg.solve(V, answers)
    return information + np.diag([s.spread**-2.0 for s in model.scales])


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
def test_the_scales_are_in_doubt_as_their_evidence_leaves_them(shown):
    """To first order: the moments follow the scales, whose precision is the average information and the priors'."""
    likelihood = likelihood_of(strides_of(80, shown=shown))
    scales = scales_of(likelihood.model)
    equations, p = equations_of(likelihood, scales), len(likelihood.unit)
    beta = equations.solve()[0]

    def left(s):
        gram = likelihood.at(s)[1]
        return gram[1:, 0] - gram[1:, 1:] @ beta

    turned = derivative(left, scales)
    expected = turned @ np.linalg.solve(precision_of_scales(likelihood, scales, beta), turned.T)
    assert_allclose(equations.moved @ equations.moved.T, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    nothing = replace(equations, noise=np.zeros((p, p)), driver_bias=np.zeros(p))
    inverse = np.linalg.inv(equations.gram[1:, 1:] + likelihood.prior)
    _, covariance, _ = nothing.solve()
    assert_allclose(covariance, inverse + 2 * inverse @ expected @ inverse, rtol=1e-3, atol=1e-4 * covariance.max())


def test_the_noise_is_in_doubt_as_its_variance_is():
    """To first order in the scales, with the average information for their precision."""
    likelihood = likelihood_of(strides_of(80))
    scales = scales_of(likelihood.model)

    def variance(logs):
        sd, time = np.exp(logs[TORQUE : TORQUE + 2])
        weight, own = mean_given_ends(DURATION, time)
        return sd**2 * (weight**2 * 2 * (1 + np.exp(-DURATION / time)) + own)

    slope = derivative(lambda s: variance(np.log(s)), scales) / variance(np.log(scales))
    equations = equations_of(likelihood, scales)
    precision = precision_of_scales(likelihood, scales, equations.solve()[0])
    expected = np.sqrt(slope @ np.linalg.solve(precision, slope))
    assert np.linalg.norm(equations.noise_moved) == pytest.approx(expected, rel=1e-3)
    with_other = np.linalg.norm(equations_of(likelihood, scales, chance=0.1).noise_moved)
    assert with_other == pytest.approx(np.hypot(0.3, expected), rel=1e-3)  # of two values, 0 with probability 0.1
