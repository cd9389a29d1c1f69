"""The mode of the scales: no other scales near it have more evidence, and a general optimiser finds none better."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dense_road import likelihood_of, scales_of, strides_of
from made_strides import made_strides
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize

from estimator.estimation.road_fit import RoadFit, fit, fit_given
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.scale_search import MIN_GAIN, most_probable
from estimator.model.conditioned import Conditioned
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road import SMOOTH
from estimator.model.road_scales import POWER, SCALES, SPEED
from estimator.signals import Floats
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY


def likelihood(shown=(), wander=SMOOTH):
    return likelihood_of(strides_of(120, seed=8, shown=shown, silence=120), 2, wander)


def centres(model) -> Floats:
    return np.array([scale.centre for scale in model.scales])


def log_posterior(found, scales, free) -> float:
    each = [found.model.scales[i] for i in free]
    z = [np.log(scales[i] / scale.centre) / scale.spread for i, scale in zip(free, each, strict=True)]
    return found.log_evidence(scales) - 0.5 * float(np.sum(np.square(z)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "shown",
    [(), ("altitude",), pytest.param(("altitude", "grade", "gravity"), marks=pytest.mark.nightly)],
    ids="+".join,
)
def test_the_mode_is_that_of_a_general_optimiser(shown):
    found = likelihood(shown)
    scales, free = found.model.scales, range(len(found.model.scales))
    best, value = most_probable(found, centres(found.model), free)
    assert value == pytest.approx(log_posterior(found, best, free))
    bounds = [(np.log(scale.low), np.log(scale.high)) for scale in scales]
    others = [
        minimize(lambda x: -log_posterior(found, np.exp(x), free), np.log(start), method="L-BFGS-B", bounds=bounds)
        for start in (centres(found.model), best)
    ]
    assert value > -min(other.fun for other in others) - MIN_GAIN


def test_from_elsewhere_the_same_mode_is_reached():
    found = likelihood(("grade",))
    free = range(len(found.model.scales))
    modes = [most_probable(found, scales_of(found.model, seed), free) for seed in (1, 2, 3)]
    for scales, value in modes:
        assert value == pytest.approx(modes[0][1], abs=0.01)
        assert_allclose(np.log(scales), np.log(modes[0][0]), atol=0.1)


@pytest.mark.parametrize("factor", [1 / 30, 30])
def test_from_far_away_where_steps_meet_bounds_the_same_mode_is_reached(factor):
    found = likelihood(("altitude",))
    scales, free = found.model.scales, range(len(found.model.scales))
    low, high = (np.array([getattr(scale, end) for scale in scales]) for end in ("low", "high"))
    _, near = most_probable(found, centres(found.model), free)
    _, value = most_probable(found, np.clip(factor * centres(found.model), low, high), free)
    assert value == pytest.approx(near, abs=0.05)


def test_a_search_ends_early_only_where_the_mode_is_not_worth_it():
    found = likelihood(("grade",))
    start, free = scales_of(found.model, 2), range(len(found.model.scales))
    mode, value = most_probable(found, start, free)
    for short in (0.1, 3.0, 30.0):
        assert_array_equal(most_probable(found, start, free, value - short)[0], mode)
    for above in (40.0, 1e6):
        early, lower = most_probable(found, start, free, value + above)
        assert lower <= value
        assert lower == pytest.approx(log_posterior(found, early, free))
    assert_allclose(most_probable(found, start, free, value + 1e9)[0], start, rtol=1e-12)
    beside = mode * 1.05
    stopped, _ = most_probable(found, beside, free, value + 40.0)
    assert_allclose(stopped, beside, rtol=1e-12)


def test_scales_that_are_not_free_stay_and_count_no_prior():
    found = likelihood()
    start = centres(found.model)
    start[4] = found.model.scales[4].low
    best, value = most_probable(found, start, [0, 1, 2, 3])
    assert_allclose(best[4:], start[4:])
    assert value == pytest.approx(log_posterior(found, best, [0, 1, 2, 3]))
    assert np.any(np.abs(np.log(best[:4] / start[:4])) > 0.1)


def test_a_scale_beyond_its_bounds_ends_on_the_bound():
    strides = strides_of(120, seed=8, unknown=(), silence=120)
    strides.a[:] *= 100  # far more noise than any bound allows
    found = likelihood_of(strides)
    best, _ = most_probable(found, centres(found.model), range(len(SCALES)))
    low, high = (np.array([getattr(scale, end) for scale in found.model.scales]) for end in ("low", "high"))
    assert np.all((best >= low * (1 - 1e-9)) & (best <= high * (1 + 1e-9)))
    assert best[SPEED] == pytest.approx(high[SPEED])


def test_scales_too_far_apart_for_floating_point_are_given_back():
    found = likelihood()
    start = centres(found.model)
    start[SPEED], start[POWER] = 1e14, 1e-14
    best, value = most_probable(found, start, [0])
    assert value == -np.inf
    assert_allclose(best, start)


@pytest.mark.slow
def test_what_slow_bends_add_to_an_accelerometer_is_no_wander_of_it():
    rng, n, (A, C, m) = np.random.default_rng(7), 1500, (250.0, 0.4, 1600.0)
    slope, wander = (gaussian_filter1d(rng.standard_normal(n), 30.0) for _ in range(2))
    slope, wander = 0.01 * slope / slope.std(), 0.002 * wander / wander.std()
    second = np.arange(n)
    wanted = np.where(second % 60 < 8, 4.0, 15.0 + 4 * np.sin(second / 21))
    speed, pull = np.full(n + 1, 15.0), np.zeros(n)
    for k in range(n):
        pull[k] = A + m * (0.3 * (wanted[k] - speed[k]) + 0.4 * np.sin(k / 7))
        speed[k + 1] = speed[k] + (pull[k] - A - C * speed[k] ** 2) / m - STANDARD_GRAVITY * slope[k]
    v = 0.5 * (speed[1:] + speed[:-1])
    lateral = np.repeat(np.where(rng.random(n // 4) < 0.5, 1.7, 0.0), 4)  # m/s^2
    centripetal = np.where(v < 8.0, 2.0 * (lateral / v) ** 2, 0.0)  # 2 m ahead of the rear axle
    made = made_strides(speed + rng.normal(0.0, 0.02, n + 1), pull + rng.normal(0.0, 30.0, n), {})
    shown = STANDARD_GRAVITY * (slope + wander + rng.normal(0.0, 0.003, n))
    found = fit(replace(made, gravity=shown + centripetal))
    assert found is not None
    noise, slow, memory = found.scales.values[-3:]
    assert noise == pytest.approx(0.003, rel=0.25)
    assert slow == pytest.approx(0.002, rel=0.25)  # 0.0048 without the variance of bends
    assert memory > 30.0  # s, and 5 s


@pytest.mark.slow
@pytest.mark.parametrize("designed", [True, False])
def test_a_road_that_is_designed_for_its_speed_is_told_from_one_whose_slopes_change_with_distance_alone(designed):
    rng, n, (A, C, m) = np.random.default_rng(1), 1500, (1500.0, 3.5, 20e3)
    profile = gaussian_filter1d(rng.standard_normal(60_000), 60.0)  # every 10 m, over 600 m
    profile *= 0.01 / profile.std()
    speed, pull, along = np.full(n + 1, 20.0), np.zeros(n), 0.0
    for k in range(n):
        v, wanted = speed[k], 6.0 if k % 300 < 120 else 22.0
        along += v * (1 + designed * (20.0 / v) ** 2)
        resistance = A + C * v**2 + m * STANDARD_GRAVITY * np.interp(along, 10.0 * np.arange(len(profile)), profile)
        pull[k] = A + C * v**2 + m * (0.05 * (wanted - v) + 0.1 * np.sin(k / 7))
        speed[k + 1] = max(v + (pull[k] - resistance) / m, 3.0)
    found = fit(made_strides(speed + rng.normal(0.0, 0.01, n + 1), pull + rng.normal(0.0, 60.0, n), {}))
    assert found is not None
    assert found.scales.designed is designed
    assert found.theta[2] == pytest.approx(m, rel=0.02)


def back_and_forth(turned: bool, seed: int) -> Strides:
    """Half an hour over hills with a stop half-way, where the vehicle ``turned`` round or went on."""
    rng, n, (A, C, m) = np.random.default_rng(seed), 1800, (1500.0, 3.5, 20e3)
    profile = gaussian_filter1d(rng.standard_normal(6_000), 40.0)  # every 10 m, over 400 m
    profile *= 0.015 / profile.std()
    speed, pull, place, way = np.full(n + 1, 15.0), np.zeros(n), 0.0, 1.0
    for k in range(n):
        v, wanted = speed[k], 4.0 if abs(k - n // 2) < 30 or k % 200 < 20 else 15.0
        way = -1.0 if turned and k > n // 2 else 1.0
        place += way * v
        slope = way * np.interp(place, 10.0 * np.arange(len(profile)), profile)
        pull[k] = A + C * v**2 + m * STANDARD_GRAVITY * slope + m * (0.1 * (wanted - v) + 0.1 * np.sin(k / 7))
        speed[k + 1] = max(v + (pull[k] - A - C * v**2) / m - STANDARD_GRAVITY * slope, 3.0)
    return made_strides(speed + rng.normal(0.0, 0.01, n + 1), pull + rng.normal(0.0, 60.0, n), {})


@cache
def fitted(turned: bool, seed: int) -> tuple[Strides, RoadFit]:
    """Such a drive, and what is found from it alone."""
    strides = back_and_forth(turned, seed)
    found = fit(strides)
    assert found is not None
    return strides, found


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (2, 3))])
@pytest.mark.parametrize("turned", [True, False])
def test_a_turn_is_told_from_other_slow_places(turned, seed):
    strides, found = fitted(turned, seed)
    half_way = float(strides.s1[900])
    assert [begin < half_way < end for begin, end in found.scales.turns] == [True] * turned
    assert found.theta[2] == pytest.approx(20e3, rel=0.03)


@pytest.mark.slow
def test_a_turn_that_gains_nothing_any_more_is_given_up():
    strides, plain = fitted(False, 1)
    place = plain.scales.model_of(strides).nodes.slow_places()[1]
    known = replace(plain.scales, turns=(place,))
    again = fit(strides, known=known)
    assert again is not None
    assert again.scales.turns == ()


@pytest.mark.slow
def test_a_search_goes_on_from_the_orders_that_lost_before(monkeypatch):
    strides, steps = back_and_forth(False, 1), list[Likelihood]()
    monkeypatch.setattr(
        Likelihood, "score", lambda found, scales, score=Likelihood.score: steps.append(found) or score(found, scales)
    )

    def again(known):
        steps.clear()
        found = fit(strides, known=known)
        assert found is not None
        return found, len(steps)

    first, _ = again(None)
    assert len({scales.orders for scales in first.scales.lost} - {first.scales.orders}) == 3
    found, fewer = again(first.scales)
    anew, number = again(replace(first.scales, lost=()))
    assert fewer < number
    assert found.scales.orders == anew.scales.orders
    assert_array_equal(found.scales.values, anew.scales.values)
    assert_array_equal(found.beta, anew.beta)


@pytest.mark.slow
def test_scales_that_cannot_be_computed_with_are_found_anew(monkeypatch):
    """Those of one part of a drive may lie too far apart for floating point on another."""
    strides, make = back_and_forth(False, 1)[:400], Conditioned.of
    found = fit(strides)
    assert found is not None

    def fail(model, scales, border=None):
        if scales[SPEED] == 1e-3:
            raise NotPositiveDefiniteError
        return make(model, scales, border)

    monkeypatch.setattr(Conditioned, "of", fail)
    values = found.scales.values.copy()
    values[SPEED] = 1e-3
    known = replace(found.scales, values=values)
    again, given = (
        fit(strides, known=known),
        fit_given(strides, known),
    )
    assert again is not None
    assert given is not None
    assert given.theta[2] == pytest.approx(found.theta[2], rel=0.01) == again.theta[2]


@pytest.mark.slow
def test_turns_behind_the_window_are_forgotten():
    strides, whole = fitted(True, 1)
    later = fit(strides[1000:], known=whole.scales)
    assert later is not None
    assert later.scales.turns == ()
