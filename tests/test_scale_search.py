"""The mode of the scales: no other scales near it have more evidence, and a general optimiser finds none better."""

import numpy as np
import pytest
from dense_road import likelihood_of, scales_of, strides_of
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from estimator.estimation.scale_search import MIN_GAIN, most_probable
from estimator.model.road import SMOOTH
from estimator.model.road_scales import POWER, SCALES, SPEED
from estimator.signals import Floats


def likelihood(shown=(), wander=SMOOTH):
    return likelihood_of(strides_of(120, seed=8, shown=shown, silence=120), 2, wander)


def centres(model) -> Floats:
    return np.array([scale.centre for scale in model.scales])


def log_posterior(found, scales, free) -> float:
    each = [found.model.scales[i] for i in free]
    z = [np.log(scales[i] / scale.centre) / scale.spread for i, scale in zip(free, each, strict=True)]
    return found.log_evidence(scales) - 0.5 * float(np.sum(np.square(z)))


@pytest.mark.parametrize("shown", [(), ("altitude",), ("altitude", "grade", "gravity")], ids="+".join)
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
