"""The posterior over A, C, m when the road is a state: its density, mode, beliefs, box and draws."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from estimator.config import Config
from estimator.estimation import posterior
from estimator.estimation.belief import Belief
from estimator.estimation.road_posterior import RoadTarget

A, C, M = 1700.0, 3.5, 20_000.0
LOWER, UPPER = np.array([0.0, 0.0, 500.0]), np.array([10_000.0, 20.0, 100_000.0])
NOTHING = Belief(np.zeros((3, 3)), np.zeros(3))


def coefficients(theta):
    a, c, m, *b = theta
    return np.array([1 / m, a / m, c / m, *(-x / m for x in b)])


def target(share=0.03, belief=NOTHING, lower=LOWER, upper=UPPER, at=(A, C, M)):
    """Coefficients known to ``share`` of their values, and correlated."""
    mean = coefficients(at)
    sd = share * np.abs(mean) * np.array([1.0, 4.0, 5.0, 6.0][: len(mean)])
    correlation = np.eye(len(mean))
    correlation[0, 1] = correlation[1, 0] = 0.5
    correlation[1, 2] = correlation[2, 1] = -0.7
    return RoadTarget(
        mean=mean, precision=np.linalg.inv(correlation * np.outer(sd, sd)), belief=belief, lower=lower, upper=upper
    )


def by_hand(t, theta):
    """The log density of one theta, as the module's docstring has it."""
    if np.any(theta < t.lower) or np.any(theta > t.upper):
        return -np.inf
    left = coefficients(theta) - t.mean
    known = theta @ t.belief.precision @ theta - 2 * theta @ t.belief.moment
    return -0.5 * (left @ t.precision @ left + known)


def about(i, mean, sd):
    unit = np.eye(3)[i]
    return Belief(np.outer(unit, unit) / sd**2, unit * mean / sd**2)


def grid(t, sds=5.0, n=81):
    """Points (n^3, 3) around the mode within the box, and the density at them, which sums to 1."""
    reach = sds * t.free_sd
    low, high = np.maximum(t.free_mode - reach, t.lower), np.minimum(t.free_mode + reach, t.upper)
    axes = [np.linspace(a, b, n) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_density = t.log_density(points)
    density = np.exp(log_density - log_density.max())
    return points, density / density.sum(), [axis[1] - axis[0] for axis in axes]


@pytest.mark.parametrize("belief", [NOTHING, about(2, 21_000.0, 300.0), about(0, 1500.0, 100.0) + about(1, 3.0, 0.2)])
def test_the_density_is_the_likelihood_of_the_coefficients_times_the_beliefs_within_the_box(belief):
    t = target(belief=belief)
    rng = np.random.default_rng(1)
    theta = np.array([A, C, M]) * rng.uniform(-0.2, 2.5, (200, 3))
    expected = np.array([by_hand(t, each) for each in theta])
    assert np.isinf(expected).any()
    assert np.isfinite(expected).sum() > 50
    assert_allclose(t.log_density(theta), expected, rtol=1e-9)


def test_an_effect_is_a_further_coefficient():
    t = target(at=(A, C, M, 500.0), lower=np.append(LOWER, -1e4), upper=np.append(UPPER, 1e4),
               belief=Belief(np.zeros((4, 4)), np.zeros(4)))  # fmt: skip
    theta = np.array([A, C, M, 500.0]) * np.random.default_rng(2).uniform(0.5, 1.5, (50, 4))
    assert_allclose(t.log_density(theta), [by_hand(t, each) for each in theta], rtol=1e-9)
    assert_allclose(t.free_mode, [A, C, M, 500.0], rtol=1e-6)


@pytest.mark.parametrize("belief", [NOTHING, about(2, 21_000.0, 300.0)])
def test_the_mode_is_the_highest_point_of_a_dense_grid(belief):
    t = target(belief=belief)
    points, density, steps = grid(t)
    highest = points[np.argmax(density)]
    assert np.all(np.abs(t.free_mode - highest) <= 1.01 * np.array(steps))
    assert t.log_density(t.free_mode[None])[0] >= t.log_density(highest[None])[0]


def test_without_beliefs_the_mode_is_where_the_drive_puts_it():
    assert_allclose(target().free_mode, [A, C, M], rtol=1e-9)


def test_a_belief_and_a_drive_of_equal_weight_meet_half_way():
    t = target(0.02)
    belief = about(2, 1.01 * M, float(t.free_sd[2]))
    both = target(0.02, belief=belief)
    assert both.free_mode[2] == pytest.approx(1.005 * M, rel=1e-3)
    assert both.free_sd[2] == pytest.approx(t.free_sd[2] / np.sqrt(2), rel=0.02)


def test_a_firm_belief_decides_and_moves_what_goes_with_it():
    t = target(belief=about(2, 22_000.0, 10.0))
    assert t.free_mode[2] == pytest.approx(22_000.0, abs=20.0)
    # 1/m is lower by three of its sd; A/m goes with it at a correlation of one half, and A is A/m times m.
    shift = (1 / 22_000.0 - 1 / M) / (0.03 / M)
    expected = (A / M) * (1 + 0.5 * 0.03 * 4 * shift) * 22_000.0
    assert t.free_mode[0] == pytest.approx(expected, rel=1e-3)


def test_outside_the_box_the_centre_is_on_its_wall_and_no_density_beyond():
    upper = np.array([1000.0, 20.0, 100_000.0])
    t = target(upper=upper)
    assert t.free_mode[0] == pytest.approx(A)
    assert t.centre[0] == pytest.approx(1000.0)
    assert t.log_density(np.array([[1000.1, C, M]]))[0] == -np.inf
    assert np.all(np.linalg.eigvalsh(t.curvature(t.centre[None])[0]) > 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "t",
    [
        pytest.param(target(), id="free"),
        pytest.param(target(belief=about(2, 20_500.0, 400.0)), id="belief"),
        pytest.param(target(upper=np.array([1700.0, 20.0, 100_000.0])), id="half cut off by the box"),
    ],
)
def test_draws_have_the_moments_of_the_density_on_a_grid(t):
    points, density, _ = grid(t)
    mean = density @ points
    sd = np.sqrt(density @ (points - mean) ** 2)
    found = posterior.sample(t, Config(), np.random.default_rng(3))
    draws = found.draws.reshape(-1, 3)
    assert found.has_converged
    assert np.all(draws >= t.lower)
    assert np.all(draws <= t.upper)
    assert np.all(np.abs(draws.mean(axis=0) - mean) < 4 * sd / np.sqrt(found.convergence.ess_bulk))
    assert_allclose(draws.std(axis=0), sd, rtol=0.08)
