"""The road model against the same Gaussian written out with dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
from made_strides import made_strides
from numpy.testing import assert_allclose

from estimator.estimation import road_fit
from estimator.estimation.road_likelihood import DRAG, LAG, PLAIN, Likelihood, earlier_loads
from estimator.model.matern import MaternField
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import (
    HEIGHT_SD,
    MAX_BRIDGE,
    MAX_PASSAGE,
    ROUGH,
    SCALES,
    SIGNALS,
    SMOOTH,
    SPACING,
    START_HEIGHT_SD,
    Nodes,
    RoadModel,
)
from estimator.strides import DURATION, LAGS, Strides
from estimator.units import STANDARD_GRAVITY

M, A, C = 20_000.0, 1500.0, 3.5
MIDDLE = len(LAGS) // 2
SHOWN = [(), ("altitude",), ("grade",), ("gravity",), SIGNALS]


def strides_of(n=40, seed=0, shown=(), unknown=(11, 12, 25), silence=20, gap=5e4, force=None) -> Strides:
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
        gravity=signals.get("gravity", blank),
    )


def scales_of(model: RoadModel, seed=0, **changes) -> np.ndarray:
    """Scales around the centres of their priors."""
    rng = np.random.default_rng(seed)
    values = {scale.name: scale.centre * rng.uniform(0.6, 1.6) for scale in model.scales}
    return np.array(list((values | {name.replace("_", " "): value for name, value in changes.items()}).values()))


def dense_field(nodes: Nodes, alpha, sd, length):
    n = len(nodes.s)
    target = np.zeros((alpha + 1, n))
    MaternField(nodes.s, nodes.joined, alpha, np.arange(n), target.shape).add_precision(target, sd, length)
    Q = sum(np.diag(target[d, : n - d], -d) for d in range(min(alpha + 1, n)))
    return np.linalg.inv(Q + np.tril(Q, -1).T)


def ou(t, other, time):
    return np.exp(-np.abs(t[:, None] - other) / time)


def wandering(model: RoadModel, sd, memory):
    t = model.nodes.t
    if model.wander == ROUGH:
        return sd**2 * ou(t, t, memory)
    return dense_field(replace(model.nodes, s=t, joined=np.insert(np.diff(t) <= MAX_PASSAGE, 0, False)), 2, sd, memory)


class Dense:
    """Covariance of motion and readings, part by part, as the module's docstring has it."""

    def __init__(self, model: RoadModel, scales):
        torque, time, speed, disturbance, sd, length = scales[:6]
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
        rate = ou(after, after, time) + ou(before, before, time) - ou(after, before, time) - ou(before, after, time)
        self.rate = torque**2 * np.outer(weight, weight) * rate * together / DURATION**2
        cross = sum(ou(one, after, time) - ou(one, before, time) for one in ends) * together
        self.force_with_rate = torque**2 * np.outer(weight, weight) * share * cross / DURATION
        K = K + self.force + disturbance**2 * np.eye(n)
        # The road, looked up at five points of a stride.
        theta = dense_field(nodes, model.alpha, sd, length)
        identity = np.eye(len(nodes.s))

        def at(s):
            return np.array([np.interp(s, nodes.s, row) for row in identity]).T

        points = zip((0.1, 0.3, 0.5, 0.7, 0.9), (0.08, 0.25, 0.34, 0.25, 0.08), strict=True)
        self.hats = sum(w * at(driven.s0 + p * (driven.s1 - driven.s0)) for p, w in points)
        # Height above the beginning of each stretch, by the trapezoid rule.
        k = len(nodes.s)
        D, W = np.eye(k), np.zeros((k, k))
        for i in np.flatnonzero(nodes.joined):
            D[i, i - 1] = -1
            W[i, [i - 1, i]] = 0.5 * (nodes.s[i] - nodes.s[i - 1])
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
            R = np.diag(noise**2 / np.minimum(counts, 10))
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
        total = B @ theta @ B.T
        at_row = 0
        for noise in noises:
            part = slice(at_row, at_row + len(noise))
            total[part, part] += noise
            at_row += len(noise)
        self.K, self.readings = total, np.concatenate(values) if values else np.empty(0)


def observed(model: RoadModel) -> np.ndarray:
    """Which rows of the data are motion or readings: height's links and starts are constraints."""
    links = len(model.nodes.s) if model.has_altitude else 0
    keep = np.ones(sum(model.counts), bool)
    keep[len(model.driven) : len(model.driven) + links] = False
    return keep


# The covariance


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(("alpha", "wander"), [(2, ROUGH), (4, ROUGH), (2, SMOOTH)])
def test_gram_and_determinant_are_those_of_the_dense_covariance(shown, alpha, wander):
    model = RoadModel(strides_of(shown=shown), alpha, wander)
    scales = scales_of(model, 3)
    assert model.reading_names == shown
    keep, dense = observed(model), Dense(model, scales)
    Y = np.zeros((len(keep), 4))
    Y[keep] = np.random.default_rng(1).normal(size=(keep.sum(), 4))
    conditioned = model.condition(scales)
    expected = Y[keep].T @ np.linalg.solve(dense.K, Y[keep])
    assert_allclose(conditioned.gram(Y), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert conditioned.log_determinant == pytest.approx(np.linalg.slogdet(dense.K)[1], abs=1e-3)


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


def test_the_road_that_is_found_is_the_conditional_mean():
    model = RoadModel(strides_of(shown=("grade",)), 4)
    scales = scales_of(model, 5)
    residual = np.random.default_rng(2).normal(0, 0.1, sum(model.counts))
    dense = Dense(model, scales)
    theta = dense_field(model.nodes, 4, scales[4], scales[5])
    B = np.vstack([-STANDARD_GRAVITY * dense.hats, np.eye(len(theta))[model.readings[0].nodes]])
    expected = theta @ B.T @ np.linalg.solve(dense.K, residual)
    slope, at_strides = model.road(model.condition(scales).unknowns(residual))
    assert_allclose(slope, expected, atol=1e-6 * np.abs(expected).max())
    middle = 0.5 * (model.driven.s0 + model.driven.s1)
    assert_allclose(at_strides, np.interp(middle, model.nodes.s, expected), atol=1e-6 * np.abs(expected).max())


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
    conditioned = model.condition(scales)
    expected = Y[keep].T @ np.linalg.solve(dense.K, Y[keep])
    assert_allclose(conditioned.gram(Y), expected, rtol=1e-5)
    assert conditioned.log_determinant == pytest.approx(np.linalg.slogdet(dense.K)[1], abs=1e-3)


def test_the_cost_does_not_grow_with_the_gaps_of_a_signal():
    whole = strides_of(1200, shown=("altitude",), silence=1200)
    width = RoadModel(whole, 2).condition(scales_of(RoadModel(whole, 2))).factor.lower.shape[0]
    gappy = RoadModel(with_gap(whole), 2)
    assert gappy.condition(scales_of(gappy)).factor.lower.shape[0] <= width


def test_one_value_of_a_signal_is_none():
    strides = strides_of(shown=("grade",))
    strides.grade[1:] = np.nan
    assert RoadModel(strides, 2).reading_names == ()


# The likelihood


def likelihood_of(strides, alpha=2):
    return Likelihood(RoadModel(strides, alpha), (), np.array([A, C, M]), MIDDLE)


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
    beta, found, _ = likelihood.solve(likelihood.model.condition(scales).gram(likelihood.data))
    assert_allclose(found, information, rtol=1e-4, atol=1e-4 * np.abs(information).max())
    assert_allclose(beta, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_noise_in_the_regressors_is_the_expectation_over_the_error_of_the_force(sign):
    n = 40
    force = sign * np.random.default_rng(4).uniform(20_000, 60_000, n)
    likelihood = likelihood_of(strides_of(n, force=force))
    model, scales = likelihood.model, scales_of(likelihood.model, 10)
    dense, conditioned = Dense(model, scales), model.condition(scales)
    beta = np.zeros(likelihood.data.shape[1] - 1)
    beta[0] = likelihood.unit[0] / M
    rng = np.random.default_rng(11)
    found = np.array([likelihood.noise_information(scales, conditioned, beta, rng) for _ in range(150)])
    inverse = np.linalg.inv(dense.K) * M**2
    expected = np.zeros_like(found[0])
    expected[0, 0] = np.sum(inverse * dense.force)
    expected[0, LAG] = expected[LAG, 0] = np.sum(inverse * dense.force_with_rate)
    expected[LAG, LAG] = np.sum(inverse * dense.rate)
    if sign < 0:  # the engine drags, and the error is one of the drag too
        expected[DRAG, DRAG] = expected[0, DRAG] = expected[DRAG, 0] = expected[0, 0]
        expected[LAG, DRAG] = expected[DRAG, LAG] = expected[0, LAG]
    expected /= np.outer(likelihood.unit, likelihood.unit)
    error = found.std(axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(found.mean(axis=0) - expected) <= 4 * error + 1e-12)
    assert error[0, 0] < 0.05 * expected[0, 0]


def test_loads_before_the_present_one_have_masses_of_their_own():
    before, now, departure = 12_000.0, 16_000.0, 20.5
    strides = strides_of(60, unknown=(), silence=60, force=np.random.default_rng(3).uniform(5_000, 30_000, 60))
    drag = C * strides.relative_density * strides.speed_squared
    m = np.where(strides.t < departure, before, now)
    strides = replace(strides, a=(strides.force[:, MIDDLE] - drag) / m - A / now)
    model = RoadModel(strides, 2)
    likelihood = Likelihood(model, (), np.array([A, C, now]), MIDDLE, (departure,))
    beta, _, _ = likelihood.solve(model.condition(scales_of(model, slope=1e-3)).gram(likelihood.data))
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
    gram = model.condition(scales).gram(np.column_stack([a, likelihood.data[:, 1:]]))
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
    found = road_fit.fit(strides, np.random.default_rng(15))
    sd = np.sqrt(np.diag(found.theta_covariance()))
    assert np.all(np.abs(found.theta[:3] - [A, C, M]) < 4 * sd[:3])
    assert sd[2] < 0.02 * M
    assert found.slope_sd == pytest.approx(0.012, rel=0.35)
    assert abs(found.lag) < 0.1
    assert found.torque_share < 0.1


def test_too_few_strides_give_no_fit():
    assert road_fit.fit(strides_of(30), np.random.default_rng(0)) is None


def test_a_speed_that_is_stuck_gives_no_fit():
    stuck = made_strides(np.full(57, 16.08), np.full(56, 262.7), {})
    assert road_fit.fit(stuck, np.random.default_rng(0)) is None


def test_a_level_road_hides_no_slopes_and_a_hilly_one_more_than_a_flatter_one():
    """R is the variance that the slopes add to 1/m, in units of that of one stride."""
    strides = strides_of(120, seed=4)
    likelihood = likelihood_of(strides)
    model = likelihood.model
    found = {}
    for slope in (model.scales[road_fit.SLOPE].low, 5e-3, 1.5e-2):
        values = scales_of(model)
        values[road_fit.SLOPE] = slope
        scales = road_fit.RoadScales(values=values, alpha=2, wander=ROUGH, readings=(), lag=likelihood.lag)
        information = likelihood.solve(model.condition(values).gram(likelihood.data))[1]
        found[slope] = road_fit.hidden_changes(likelihood, scales, information, 1.0)
        dense = np.linalg.inv(information)[0, 0]
        assert found[slope] <= len(model.driven) * dense
    level, some, more = found.values()
    assert level == 0.0
    assert 0 < some < more


def test_hidden_slopes_count_by_the_strides_of_the_present_load():
    """The variance is that of the mass since the last departure; so is the number of strides that it is spread over."""
    strides = strides_of(240, seed=4)
    changed = float(strides.t[-40])
    model = RoadModel(strides, 2)
    likelihood = Likelihood(model, (), np.array([A, C, M]), MIDDLE, (changed,))
    level = scales_of(model)
    level[road_fit.SLOPE] = model.scales[road_fit.SLOPE].low
    informations = [
        likelihood.solve(model.condition(values).gram(likelihood.data))[1] for values in (scales_of(model), level)
    ]
    sloping, flat = (np.linalg.inv(information)[0, 0] for information in informations)
    scales = road_fit.RoadScales(values=scales_of(model), alpha=2, wander=ROUGH, readings=(), lag=likelihood.lag)
    present = np.count_nonzero(strides[strides.t >= changed].known)
    found = road_fit.hidden_changes(likelihood, scales, informations[0], 1.0)
    assert found == pytest.approx(present * (sloping - flat))


def test_hidden_slopes_that_hide_the_mass_count_up_to_a_limit():
    strides = strides_of(120, seed=4)
    likelihood = likelihood_of(strides)
    values = scales_of(likelihood.model)
    scales = road_fit.RoadScales(values=values, alpha=2, wander=ROUGH, readings=(), lag=likelihood.lag)
    information = likelihood.solve(likelihood.model.condition(values).gram(likelihood.data))[1]
    assert road_fit.hidden_changes(likelihood, scales, information, 1e-9) == road_fit.MAX_HIDDEN_CHANGES
