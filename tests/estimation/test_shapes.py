"""Shapes of effects that no signal tells: their evidence by brute force, and truths between those of a grid."""

from dataclasses import replace

import numpy as np
import pytest
from made_strides import made_strides
from numpy.testing import assert_allclose

from estimator.estimation.road_fit import RoadFit, fit, fit_given
from estimator.estimation.road_likelihood import LAG, Likelihood
from estimator.estimation.shapes import (
    ShapeLikelihood,
    averaged,
    best_shapes,
    fitted_with_shapes,
    is_free,
    nearer_shapes,
)
from estimator.model.conditioned import Conditioned
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import BY_NAME
from estimator.model.effects.cold import cold_by_time, excess, excesses, finer_excesses
from estimator.model.effects.effect import View
from estimator.signals import Quantity

M, A, C = 25e3, 1600.0, 3.5
WIND = BY_NAME["headwind"]
OIL = replace(  # that warms with the time, which is simpler to compute a drive of
    BY_NAME["oil_warm_up"],
    power=lambda view, shape: view.v**2 * excess(cold_by_time(view, shape[0]), shape[1]),
    needs=(Quantity.ELAPSED,),
    shapes=excesses((600.0, 960.0, 1500.0, 2400.0)),
    finer_shapes=finer_excesses,
)
COLD = [EffectTerm(OIL, shape) for shape in OIL.shapes]
WINDS = [EffectTerm(WIND, shape) for shape in WIND.shapes]
STEADY_WIND = replace(WIND, finer_shapes=None)
SEED = 11


def at(n=1500):
    """The times of a drive, for what falls with them."""
    t, zero = np.arange(n) + 0.5, np.zeros(n)
    context, road_load = {Quantity.ELAPSED: t}, np.array([A, C, M])
    return View(t=t, v=zero + 1, a=zero, P=zero, density=zero, context=context, road_load=road_load)


def driven(n=1500, size=0.0, term=COLD[0]):
    """A drive on a level road that turns to all sides, where ``term`` takes its power for a ``size``."""
    rng, t = np.random.default_rng(SEED), np.arange(n) + 0.5
    speed = 15 + 5 * np.sin(2 * np.pi * np.arange(n + 1) / 90) + 2 * np.sin(2 * np.pi * np.arange(n + 1) / 37)
    v = 0.5 * (speed[1:] + speed[:-1])
    context = {Quantity.ELAPSED: t, Quantity.HEADING: 2 * np.pi * t / 600}
    unknown = np.full(n, np.nan)
    view = View(
        t=t,
        v=v,
        a=unknown,
        P=unknown,
        density=np.ones(n),
        context=context,
        road_load=np.array([A, C, M]),
    )
    force = M * np.diff(speed) + A + C * v**2 + size * term.column(view) / v + M * rng.normal(0, 4e-3, n)
    return made_strides(speed, force, context)


def fitted(strides):
    def beside(terms, known):
        return fit(strides, terms, known)

    return beside


def evidence(strides, found, terms):
    model = found.scales.model_of(strides)
    road_load = np.maximum(found.theta[:3], 1e-9)
    likelihood = Likelihood(model, terms, road_load, found.scales.lag, found.departures, found.taken)
    solved, _, _ = likelihood.solve(Conditioned.of(model, found.scales.values).gram(likelihood.data))
    return likelihood.log_evidence(found.scales.values), solved / likelihood.unit


def test_the_gain_of_a_shape_is_the_difference_of_log_evidences():
    strides = driven(400, 40.0, EffectTerm(OIL, (500.0, 0.0)))
    found = fit(strides, (WINDS[0],))
    assert found is not None
    judged = ShapeLikelihood(strides, found).judged((WINDS[0],), COLD)
    without, _ = evidence(strides, found, (WINDS[0],))
    each = [evidence(strides, found, (WINDS[0], term)) for term in COLD]
    assert_allclose(judged.gains, [log - without for log, _ in each], atol=1e-6)
    assert_allclose(judged.exact_gains, judged.gains)  # the column of each is exact at any magnitude
    assert_allclose(judged.coefficients, [solved for _, solved in each], rtol=1e-6, atol=1e-12)


def test_a_wind_of_another_speed_than_that_of_its_column_gains_less():
    """One standard deviation of the magnitude away from the speed at which the column is exact costs one half."""
    strides = driven(400, 6.0, EffectTerm(WIND, (0.35, 0.07, 0.24, 6.0)))
    found = fit(strides)
    assert found is not None
    likelihood = ShapeLikelihood(strides, found)
    (size,) = likelihood.judged((), [EffectTerm(WIND, (0.35, 0.07, 0.24, 6.0))]).magnitudes
    for _ in range(20):
        (size,) = likelihood.judged((), [EffectTerm(WIND, (0.35, 0.07, 0.24, size))]).magnitudes
    judged = likelihood.judged((), [EffectTerm(WIND, (0.35, 0.07, 0.24, speed)) for speed in (size, 1.2 * size)])
    assert judged.exact_gains[0] == pytest.approx(judged.gains[0], abs=1e-6)
    sd = 1 / (judged.coefficients[1, 0] * np.sqrt(judged.precision[1]))
    away = (1.2 * size - judged.magnitudes[1]) / sd
    assert judged.gains[1] - judged.exact_gains[1] == pytest.approx(0.5 * away**2)
    assert away > 1


def test_a_shape_with_the_wrong_sign_adds_nothing():
    strides = driven(400, -40.0, EffectTerm(OIL, (500.0, 0.0)))
    found = fit(strides)
    assert found is not None
    judged = ShapeLikelihood(strides, found).judged((), COLD)
    assert (judged.magnitudes < 0).all()
    assert (judged.gains < 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("tau", [600.0, 960.0])
def test_of_several_shapes_the_one_that_the_drive_shows_is_taken(tau):
    strides = driven(size=60.0, term=EffectTerm(OIL, (tau, 0.0)))
    found = fit(strides)
    guess = best_shapes(strides, found, [COLD])  # beside scales that have taken some of it up
    beside = fit(strides, guess, found.scales)
    (term,) = best_shapes(strides, beside, [COLD])
    assert term.shape[0] == pytest.approx(tau, rel=0.7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "size", "start"),
    [(EffectTerm(WIND, (0.35, 0.07, 0.24, 9.0)), 9.0, WINDS), (EffectTerm(OIL, (700.0, 2.0)), 50.0, COLD[:1])],
    ids=["wind", "oil"],
)
def test_a_shape_between_those_of_the_grid_is_found_with_its_magnitude(truth, size, start):
    strides = driven(size=size, term=truth)
    plain = fit(strides)
    coarse = fit(strides, best_shapes(strides, plain, [start]))
    found = fitted_with_shapes(strides, coarse.terms, fitted(strides))
    assert isinstance(found, RoadFit)
    (term,), sd = found.terms, np.sqrt(np.diag(found.theta_covariance()))
    if truth.effect is WIND:
        direction, yawed, largest, speed = term.shape
        assert direction == pytest.approx(0.35, abs=0.01)
        assert yawed == pytest.approx(0.07, abs=0.02)
        assert largest == pytest.approx(0.24, abs=0.03)
        assert speed == pytest.approx(found.theta[LAG + 1], rel=0.01)  # the column is that of the wind found
    else:
        assert_allclose(OIL.power(at(), term.shape), OIL.power(at(), truth.shape), atol=0.05)
    assert found.theta[LAG + 1] == pytest.approx(size, abs=3 * sd[LAG + 1] + 0.02 * size)
    assert np.abs(found.theta[0] - A) < 3 * sd[0]
    assert found.log_evidence > coarse.log_evidence + 1


@pytest.mark.slow
def test_coefficients_are_averaged_over_shapes_that_fit_alike():
    """The law of total variance, over fits with one shape each."""
    strides = driven(700, 30.0, EffectTerm(OIL, (500.0, 1.0)))
    found = fit(strides, (WINDS[0], COLD[3]))
    whole = averaged(strides, found)
    over_cold = averaged(strides, replace(found, terms=(replace(WINDS[0], effect=STEADY_WIND), COLD[3])))
    near = {*OIL.shapes, *OIL.finer_shapes(COLD[3].shape, 0.0)}
    each = [evidence(strides, found, (WINDS[0], EffectTerm(OIL, shape))) for shape in sorted(near)]
    log = np.array([log for log, _ in each])
    weights = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    coefficients = np.array([solved for _, solved in each])
    mean = weights @ coefficients
    spread = (coefficients - mean).T @ ((coefficients - mean) * weights[:, None])
    _, own = evidence(strides, found, found.terms)
    unit = np.sqrt(np.diag(spread)) + 1e-12  # the lag of a force that is the same at all of them has none
    assert_allclose((over_cold.beta - found.beta) / unit, (mean - own) / unit, atol=1e-3)
    added = over_cold.covariance - found.covariance
    assert_allclose(added / np.outer(unit, unit), spread / np.outer(unit, unit), atol=1e-3)
    assert unit[1] > 0.2 * np.sqrt(found.covariance[1, 1])  # it matters
    assert (np.diag(whole.covariance) >= np.diag(over_cold.covariance) - 1e-15).all()


def test_without_shapes_a_fit_is_its_own_average():
    strides = driven(300)
    found = fit(strides)
    assert averaged(strides, found) is found


def test_shapes_that_nothing_is_to_be_gained_by_stay():
    strides = driven(600, 5.0, WINDS[5])
    found = fitted_with_shapes(strides, (WINDS[5],), fitted(strides))
    assert nearer_shapes(strides, found) == found.terms


def test_shapes_that_signals_tell_are_not_varied():
    fan = EffectTerm(BY_NAME["auxiliary_cycling"], Quantity.FAN_SPEED)
    assert not is_free(fan)
    assert is_free(COLD[0])
    strides = driven(300)
    strides = replace(strides, context={**strides.context, Quantity.FAN_SPEED: (strides.t % 100 > 50) * 100.0})
    calls = []

    def counted(terms, known):
        calls.append(terms)
        return fit(strides, terms, known)

    assert fitted_with_shapes(strides, (fan,), counted) is not None
    assert calls == [(fan,)]


def test_a_drive_that_cannot_be_fitted_has_no_shapes():
    assert fitted_with_shapes(driven(5), (COLD[0],), fitted(driven(5))) is None


@pytest.mark.slow
def test_effects_scale_with_the_road_load_that_is_found_when_scales_are_given():
    strides = driven(size=0.5, term=COLD[1])
    found = fit(strides, (COLD[1],))
    given = fit_given(strides, found.scales, found.terms)
    assert_allclose(given.theta, found.theta, rtol=2e-3, atol=1e-3)
