"""The road model against the same Gaussian written out with dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from dense_road import (
    MIDDLE,
    ORDERS,
    SHOWN,
    A,
    C,
    Dense,
    M,
    dense_field,
    likelihood_of,
    observed,
    scales_of,
    strides_of,
)
from made_strides import made_strides
from numpy.testing import assert_allclose

from estimator.estimation import form_doubt, road_fit, road_search
from estimator.estimation.road_likelihood import DRAG, LAG, PLAIN, Likelihood, earlier_loads
from estimator.model.conditioned import Conditioned
from estimator.model.road import LEVEL, RoadModel
from estimator.model.road_nodes import MAX_BRIDGE, SPACING, Nodes, Reading
from estimator.model.road_scales import LENGTH, POWER, SLOPE, TORQUE
from estimator.strides import LAGS, Strides
from estimator.units import STANDARD_GRAVITY

# The covariance


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(("alpha", "wander"), ORDERS)
def test_gram_and_determinant_are_those_of_the_dense_covariance(shown, alpha, wander):
    model = RoadModel(strides_of(shown=shown), alpha, wander)
    scales = scales_of(model, 3)
    assert model.reading_names == shown
    assert_has_the_covariance(model, scales, Dense(model, scales))


@pytest.mark.parametrize("shown", SHOWN[:2], ids="+".join)
def test_slopes_of_a_designed_road_change_over_its_own_distance_and_heights_over_metres(shown):
    model = RoadModel(strides_of(shown=shown), 2, designed=True)
    scales = scales_of(model, 3)
    assert_has_the_covariance(model, scales, Dense(model, scales))


def assert_has_the_covariance(model, scales, dense):
    keep = observed(model)
    Y = np.zeros((len(keep), 4))
    Y[keep] = np.random.default_rng(1).normal(size=(keep.sum(), 4))
    conditioned = Conditioned.of(model, scales)
    expected = Y[keep].T @ np.linalg.solve(dense.K, Y[keep])
    assert_allclose(conditioned.gram(Y), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert conditioned.log_determinant == pytest.approx(np.linalg.slogdet(dense.K)[1], abs=1e-3)


@pytest.mark.parametrize("alpha", [2, LEVEL])
def test_a_model_without_noise_of_the_power_is_that_with_none(alpha):
    model = RoadModel(strides_of(shown=("altitude",)), alpha, power=False)
    scales = scales_of(model, 3)
    none = scales.copy()
    none[POWER] = 0.0
    assert_has_the_covariance(model, scales, Dense(model, none))


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
def test_data_hold_the_response_the_readings_and_an_offset_for_each_signal_of_slope(shown):
    model = RoadModel(strides_of(shown=shown), 2)
    keep, dense = observed(model), Dense(model, scales_of(model))
    data = model.given(np.column_stack([model.driven.a, model.driven.force]))
    n, offsets = len(model.driven), [name for name in shown if name != "altitude"]
    assert data.shape == (len(keep), 1 + len(LAGS) + len(offsets))
    assert_allclose(data[:n, 0], model.driven.a)
    assert_allclose(data[keep][n:, 0], dense.readings)
    assert not data[~keep].any()
    assert not data[n:, 1 : 1 + len(LAGS)].any()
    assert_allclose(data[:, 1 + len(LAGS) :].sum(axis=0), [len(r.values) for r in model.readings if r.name in offsets])


@pytest.mark.parametrize("alpha", [4, LEVEL])
def test_the_road_that_is_found_is_the_conditional_mean(alpha):
    model = RoadModel(strides_of(shown=("grade",)), alpha)
    scales = scales_of(model, 5)
    residual = np.random.default_rng(2).normal(0, 0.1, sum(model.counts))
    dense = Dense(model, scales)
    theta = dense_field(model.nodes, alpha, scales[4], scales[5])
    B = np.vstack([-STANDARD_GRAVITY * dense.hats, np.eye(len(theta))[model.readings[0].nodes]])
    expected = theta @ B.T @ np.linalg.solve(dense.K, residual)
    slope, at_strides = model.road(Conditioned.of(model, scales).unknowns(residual))
    assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())
    middle = 0.5 * (model.driven.s0 + model.driven.s1)
    assert_allclose(at_strides, np.interp(middle, model.nodes.s, expected), atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("alpha", [2, LEVEL])
def test_the_errors_of_the_sensors_are_their_conditional_mean(alpha):
    """Those of speed, torque and power together, but for the part that no two strides share."""
    model = RoadModel(strides_of(), alpha)
    scales = scales_of(model, 5, power_noise=0.05)
    residual = np.random.default_rng(2).normal(0, 0.1, sum(model.counts))
    dense = Dense(model, scales)
    expected = dense.sensors @ np.linalg.solve(dense.K, residual)
    found = model.sensor_errors(Conditioned.of(model, scales).unknowns(residual))
    assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("speed", "factor"), [(40.0, 1.25), (20.0, 2.0), (10.0, 5.0), (5.0, 17.0), (0.5, 17.0)])
def test_slopes_of_a_designed_road_change_the_sooner_the_slower_it_is_driven(speed, factor):
    nodes = Nodes.under(made_strides(np.full(401, speed), np.zeros(400), {}))
    assert_allclose(np.diff(nodes.along(designed=True, turns=())), SPACING * factor)


def test_a_gap_of_a_designed_road_is_as_slow_as_the_road_beside_it():
    made = strides_of(gap=0.8 * MAX_BRIDGE)
    nodes, last = Nodes.under(made), int(np.argmax(np.diff(made.s0)))
    between = (nodes.s[1:] > made.s1[last] + SPACING) & (nodes.s[:-1] < made.s0[last + 1] - SPACING)
    factors = np.diff(nodes.along(designed=True, turns=()))[between] / SPACING
    beside = 1 + (20.0 / (made.s1 - made.s0)[[last, last + 1]]) ** 2
    assert between.sum() > 20
    assert np.all((factors >= beside.min()) & (factors <= beside.max()))


def test_strides_that_overlap_count_once_on_a_designed_road():
    whole = made_strides(np.full(401, 10.0), np.zeros(400), {})
    order = np.sort(np.concatenate([np.arange(400), np.arange(3, 400, 7)]))
    later = np.append(False, np.diff(order) == 0) * 5.0  # m
    twice = whole[order]
    twice = replace(twice, s0=twice.s0 + later, s1=twice.s1 + later)
    assert_allclose(*(Nodes.under(each).along(designed=True, turns=()) for each in (twice, whole)))


def test_slopes_change_at_once_where_the_vehicle_turns():
    speed = np.interp(np.arange(401), [0, 150, 170, 190, 230, 260, 300, 400], [15, 15, 4, 4, 15, 15, 2, 2])
    nodes = Nodes.under(made_strides(speed, np.zeros(400), {}))
    turn, slow_end = nodes.slow_places()
    driven = np.cumsum(np.append(0.0, 0.5 * (speed[1:] + speed[:-1])))
    second = np.interp(turn, driven, np.arange(401))
    assert 164 < second[0] < 170  # 6 m/s are passed at 166.4 s and 197.3 s
    assert 190 < second[1] < 200
    assert slow_end[1] == nodes.s[-1]
    factors = np.diff(nodes.along(designed=False, turns=[turn])) / SPACING
    middle = 0.5 * (nodes.s[1:] + nodes.s[:-1])
    assert_allclose(factors, np.where((middle > turn[0]) & (middle < turn[1]), 17.0, 1.0))


def test_a_stride_without_a_speed_takes_no_other_from_a_map():
    made = made_strides(np.linspace(10, 20, 401), np.zeros(400), {})
    shown = replace(made, grade=np.full(400, 0.01), grade_offset_sd=np.full(400, 0.002))
    lost = np.isin(np.arange(400), [100, 101])
    gone = replace(shown, v0=np.where(lost, np.nan, shown.v0), known=shown.known & ~lost)
    whole, some = (Reading.of("grade", each, Nodes.under(shown)) for each in (shown, gone))
    assert np.isfinite(some.offsets).all()
    assert_allclose(some.offsets, whole.offsets, rtol=0.02)


def test_nodes_bridge_short_gaps_and_end_before_long_ones():
    short, far = (Nodes.under(strides_of(gap=gap)) for gap in (0.8 * MAX_BRIDGE, 1.2 * MAX_BRIDGE))
    assert short.joined.sum() == len(short.s) - 1
    assert far.joined.sum() == len(far.s) - 2
    for nodes in (short, far):
        assert_allclose(np.diff(nodes.s)[nodes.joined[1:]], SPACING)
        assert np.all(np.diff(nodes.t) > 0)
    strides = strides_of()
    before, share = far.between(strides.s0[:20])
    assert_allclose(far.s[before] + SPACING * share, strides.s0[:20])
    assert np.all((share >= 0) & (share <= 1))


def with_gap(strides: Strides) -> Strides:
    """An altitude that is away for a while."""
    middle = slice(len(strides) // 4, -len(strides) // 4)
    strides.altitude[middle] = np.nan
    return strides


def test_a_signal_that_comes_and_goes_is_one_chain_over_the_gap():
    model = RoadModel(with_gap(strides_of(shown=("altitude",))), 2)
    scales = scales_of(model, 4, altitude_wander_time=500.0)
    keep, dense = observed(model), Dense(model, scales)
    Y = np.zeros((len(keep), 1))
    Y[keep] = np.random.default_rng(1).normal(size=(keep.sum(), 1))
    conditioned = Conditioned.of(model, scales)
    expected = Y[keep].T @ np.linalg.solve(dense.K, Y[keep])
    assert_allclose(conditioned.gram(Y), expected, rtol=1e-5)
    assert conditioned.log_determinant == pytest.approx(np.linalg.slogdet(dense.K)[1], abs=1e-3)


def test_the_cost_does_not_grow_with_the_gaps_of_a_signal():
    whole = strides_of(1200, shown=("altitude",), silence=1200)
    width = Conditioned.of(RoadModel(whole, 2), scales_of(RoadModel(whole, 2))).factor.lower.shape[0]
    gappy = RoadModel(with_gap(whole), 2)
    assert Conditioned.of(gappy, scales_of(gappy)).factor.lower.shape[0] <= width


def test_one_value_of_a_signal_is_none():
    strides = strides_of(shown=("grade",))
    strides.grade[1:] = np.nan
    assert RoadModel(strides, 2).reading_names == ()


# The likelihood


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
def test_the_evidence_is_the_marginal_likelihood_with_the_coefficients_integrated_out(shown):
    likelihood = likelihood_of(strides_of(shown=shown))
    model = likelihood.model
    keep = observed(model)

    def by_hand(scales):
        data = likelihood.data[keep]
        prior = np.linalg.inv(likelihood.prior)
        total = Dense(model, scales).K + data[:, 1:] @ prior @ data[:, 1:].T
        white = np.linalg.solve(np.linalg.cholesky(total), data[:, 0])
        return -0.5 * (np.linalg.slogdet(total)[1] + white @ white)

    for scales in (scales_of(model, 7), scales_of(model, 8)):
        assert likelihood.log_evidence(scales) == pytest.approx(by_hand(scales), rel=1e-5, abs=0.01)


def test_the_coefficients_are_the_posterior_mean_of_the_dense_gaussian():
    likelihood = likelihood_of(strides_of(shown=("altitude", "grade")))
    scales, keep = scales_of(likelihood.model, 9), observed(likelihood.model)
    data, K = likelihood.data[keep], Dense(likelihood.model, scales).K
    information = data[:, 1:].T @ np.linalg.solve(K, data[:, 1:]) + likelihood.prior
    expected = np.linalg.solve(information, data[:, 1:].T @ np.linalg.solve(K, data[:, 0]))
    beta, found, _ = likelihood.solve(Conditioned.of(likelihood.model, scales).gram(likelihood.data))
    assert_allclose(found, information, rtol=1e-4, atol=1e-4 * np.abs(information).max())
    assert_allclose(beta, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_noise_in_the_regressors_is_the_expectation_over_the_error_of_the_force(sign):
    n = 40
    force = sign * np.random.default_rng(4).uniform(20_000, 60_000, n)
    likelihood = likelihood_of(strides_of(n, force=force))
    model, scales = likelihood.model, scales_of(likelihood.model, 10)
    dense, conditioned, still = Dense(model, scales), Conditioned.of(model, scales), np.empty((len(model.driven), 0))
    found = M**2 * likelihood.noise_information(conditioned, likelihood.by_force(still))
    inverse = np.linalg.inv(dense.K) * M**2
    expected = np.zeros_like(found)
    expected[0, 0] = np.sum(inverse * dense.force)
    expected[0, LAG] = expected[LAG, 0] = np.sum(inverse * dense.force_with_rate)
    expected[LAG, LAG] = np.sum(inverse * dense.rate)
    if sign < 0:  # the engine drags, and the error is one of the drag too
        expected[DRAG, DRAG] = expected[0, DRAG] = expected[DRAG, 0] = expected[0, 0]
        expected[LAG, DRAG] = expected[DRAG, LAG] = expected[0, LAG]
    expected /= np.outer(likelihood.unit, likelihood.unit)
    own = np.sqrt(np.maximum(np.diag(expected), 1e-300))
    assert_allclose(found[LAG, LAG], expected[LAG, LAG], rtol=0.15)
    found[LAG, LAG] = expected[LAG, LAG]
    assert_allclose(found / np.outer(own, own), expected / np.outer(own, own), atol=1e-3)


def test_noise_of_the_torque_in_columns_that_change_slowly_is_nearly_that_of_the_dense_covariance():
    likelihood = likelihood_of(strides_of(120, unknown=(), silence=120))
    model, scales, n = likelihood.model, scales_of(likelihood.model, 10), len(likelihood.model.driven)
    dense, rng = Dense(model, scales), np.random.default_rng(5)
    by_torque = np.column_stack([np.ones(n), np.linspace(-0.5, 0.5, n), 1 + np.cumsum(rng.normal(0.0, 0.05, n))])
    products, _ = Conditioned.of(model, scales).torque_noise(sp.csc_array(by_torque))
    expected = by_torque.T @ (np.linalg.inv(dense.K) * dense.force) @ by_torque
    assert products[0, 0] == pytest.approx(expected[0, 0], rel=1e-3)
    own = np.sqrt(np.diag(expected))
    assert_allclose(products / np.outer(own, own), expected / np.outer(own, own), atol=0.03)


def test_loads_before_the_present_one_have_masses_of_their_own():
    before, now, departure = 12_000.0, 16_000.0, 20.5
    strides = strides_of(60, unknown=(), silence=60, force=np.random.default_rng(3).uniform(5_000, 30_000, 60))
    drag = C * strides.relative_density * strides.speed_squared
    m = np.where(strides.t < departure, before, now)
    strides = replace(strides, a=(strides.force[:, MIDDLE] - drag) / m - A / now)
    model = RoadModel(strides, 2)
    likelihood = Likelihood(model, (), np.array([A, C, now]), MIDDLE, (departure,))
    beta, _, _ = likelihood.solve(Conditioned.of(model, scales_of(model, slope=1e-3)).gram(likelihood.data))
    beta = beta / likelihood.unit
    assert 1 / beta[0] == pytest.approx(now, rel=0.01)
    assert 1 / (beta[0] + beta[PLAIN]) == pytest.approx(before, rel=0.01)


def test_times_belong_to_the_load_of_the_departure_before_them():
    t = np.array([0.0, 5.0, 10.0, 15.0, 25.0])
    assert_allclose(earlier_loads(t, ()), np.zeros((5, 0)))
    assert_allclose(earlier_loads(t, (10.0, 20.0)).T, [[1, 1, 0, 0, 0], [0, 0, 1, 1, 0]])
    assert_allclose(earlier_loads(t, (10.0, 20.0, 22.0, 30.0)).T, [[1, 1, 0, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 1]])


# Truth drawn from the model


def drawn(model: RoadModel, scales, rng, count):
    """Accelerations (n, count) by the road and all noise of the model."""
    return np.linalg.cholesky(Dense(model, scales).K) @ rng.normal(size=(len(model.driven), count))


def test_the_mass_is_as_far_from_the_truth_as_its_standard_deviation_says():
    n, draws = 120, 200
    force = np.random.default_rng(6).normal(4000, 8000, n)
    likelihood = likelihood_of(strides_of(n, force=force, unknown=(30, 31, 70), silence=90))
    model = likelihood.model
    scales = scales_of(model, torque_noise=1e-4)
    rng = np.random.default_rng(12)
    # Nuisances are drawn from their priors; the vehicle is always the same.
    beta = np.tile(np.array([1 / M, A / M, C / M, 0, 0])[:, None] * likelihood.unit[:PLAIN, None], draws)
    sd = 1 / np.sqrt(np.diag(likelihood.prior))
    beta[LAG : DRAG + 1] = sd[LAG : DRAG + 1, None] * rng.normal(size=(2, draws))
    a = likelihood.data[:, 1:] @ beta + drawn(model, scales, rng, draws)
    gram = Conditioned.of(model, scales).gram(np.column_stack([a, likelihood.data[:, 1:]]))
    information = gram[draws:, draws:] + likelihood.prior
    found = np.linalg.solve(information, gram[draws:, :draws])
    z = (found - beta)[:3] / np.sqrt(np.diag(np.linalg.inv(information)))[:3, None]
    assert np.all(np.abs(np.sqrt(np.mean(z**2, axis=1)) - 1) < 0.2)
    assert np.all(np.abs(z.mean(axis=1)) < 4 / np.sqrt(draws))


@pytest.mark.slow
def test_a_fit_finds_the_vehicle_and_the_hills_that_the_strides_were_drawn_with():
    n, rng = 900, np.random.default_rng(13)
    force = np.repeat(rng.normal(3000, 9000, n // 15), 15)
    strides = strides_of(n, seed=14, force=force, unknown=range(200, 230), silence=n)
    strides.gearing[:], strides.density[:] = 10.0, 1.2
    smooth = np.convolve(force, np.ones(5) / 5, mode="same")
    strides.force[:] = smooth[:, None] + np.gradient(smooth)[:, None] * LAGS
    model = RoadModel(strides, 4)
    truth = scales_of(model, torque_noise=1e-4, slope=0.012, slope_length=300.0)
    a = np.full(n, np.nan)
    driven = model.driven
    a[strides.known] = driven.force[:, MIDDLE] / M - A / M - C / M * driven.speed_squared
    a[strides.known] += drawn(model, truth, rng, 1)[:, 0]
    strides.a[:] = a
    found = road_fit.fit(strides)
    sd = np.sqrt(np.diag(found.theta_covariance()))
    assert np.all(np.abs(found.theta[:3] - [A, C, M]) < 4 * sd[:3])
    assert sd[2] < 0.02 * M
    assert found.slope_sd == pytest.approx(0.012, rel=0.35)
    assert abs(found.lag) < 0.1
    assert found.equations.solve()[2] < 0.1  # share of noise in the information on 1/m


def test_the_sd_of_the_slopes_is_that_along_the_road_where_that_of_the_process_is_larger():
    n, amplitude = 900, 0.02
    strides = strides_of(n, seed=21, force=np.full(n, 4000.0), unknown=(), silence=n)
    rng = np.random.default_rng(22)
    force = np.repeat(rng.normal(3000, 9000, n // 15), 15)
    strides.force[:] = force[:, None]
    strides.gearing[:], strides.density[:] = 10.0, 1.2
    strides.a[:] = force / M - A / M - C / M * strides.speed_squared + rng.normal(0, 2e-3, n)
    strides.a[:] -= STANDARD_GRAVITY * amplitude * np.sin(2 * np.pi * (strides.s0 + strides.s1) / 2 / 2000)
    found = road_fit.fit(strides)
    assert found.slope_sd == pytest.approx(amplitude / np.sqrt(2), rel=0.1)
    assert found.scales.values[SLOPE] > 1.25 * found.slope_sd
    assert found.slope_length < found.scales.values[LENGTH]
    designed = replace(found, scales=replace(found.scales, designed=True))
    factor = np.mean(1 + (20.0 / np.maximum(found.strides.speed, 5.0)) ** 2)
    assert designed.slope_length == pytest.approx(found.slope_length / factor)  # in metres of the road


def test_power_that_no_signal_shows_is_told_from_noise_of_the_torque():
    strides = strides_of(250, seed=3, unknown=(), silence=250)
    likelihood = likelihood_of(strides)
    model = likelihood.model
    truth = scales_of(model, torque_noise=1e-4, slope=1e-4, power_noise=0.05, power_noise_time=1.5)
    strides.a[:] = strides.force[:, MIDDLE] / M - A / M - C / M * strides.speed_squared
    strides.a[:] += drawn(model, truth, np.random.default_rng(4), 1)[:, 0]
    found = road_fit.fit(strides, level=True)
    assert found.scales.values[POWER] == pytest.approx(0.05, rel=0.2)
    assert found.scales.values[TORQUE] < 0.01
    sd = np.sqrt(np.diag(found.theta_covariance()))
    assert np.all(np.abs(found.theta[:3] - [A, C, M]) < 3 * sd[:3])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_torque_is_not_taken_for_that_of_the_power(seed):
    strides = strides_of(250, seed=3, unknown=(), silence=250)
    model = likelihood_of(strides).model
    truth = scales_of(model, torque_noise=0.03, torque_noise_time=0.5, slope=1e-4, power_noise=1e-4)
    strides.a[:] = strides.force[:, MIDDLE] / M - A / M - C / M * strides.speed_squared
    strides.a[:] += drawn(model, truth, np.random.default_rng(seed), 1)[:, 0]
    found = road_fit.fit(strides, level=True)
    assert not found.scales.has_power
    assert found.scales.values[TORQUE] == pytest.approx(0.03, rel=0.3)


def test_too_few_strides_give_no_fit():
    assert road_fit.fit(strides_of(30)) is None


def test_a_speed_that_is_stuck_gives_no_fit():
    stuck = made_strides(np.full(57, 16.08), np.full(56, 262.7), {})
    assert road_fit.fit(stuck) is None


def test_an_effect_of_doubtful_form_moves_the_others_as_their_fit_with_another_size_would():
    rng = np.random.default_rng(5)
    X = rng.normal(size=(200, 5)) @ rng.normal(size=(5, 5))
    y = X @ np.array([1.0, -2.0, 0.5, 3.0, -1.0]) + rng.normal(size=200)
    beta, covariance = np.linalg.lstsq(X, y, rcond=None)[0], np.linalg.inv(X.T @ X)
    added = np.zeros_like(covariance)
    for held in (3, 4):
        size = (1 + form_doubt.EFFECT_DOUBT) * beta[held]
        free = [i for i in range(5) if i != held]
        moved = np.full(5, size)
        moved[free] = np.linalg.lstsq(X[:, free], y - X[:, held] * size, rcond=None)[0]
        added += np.outer(moved - beta, moved - beta)
    wider = form_doubt.with_doubt_of_effects(beta, covariance, 2)
    assert_allclose(wider, covariance + added, rtol=1e-9)
    assert_allclose(form_doubt.with_doubt_of_effects(beta, covariance, 0), covariance)


def test_effects_scale_with_a_road_load_that_a_vehicle_can_have():
    beta = np.array([1 / M, A / M, C / M, 0.01])
    assert_allclose(road_search.scaled_by(beta), [A, C, M])
    below = road_search.scaled_by(beta * [1, -1, -1, 1])
    assert_allclose(below, [0.002 * 9.80665 * M, 2e-5 * M, M])
    assert_allclose(road_search.scaled_by(np.zeros(3))[2], 1e6)
