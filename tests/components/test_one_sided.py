"""Gaussians cut at zero, against exact moments and against draws."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import truncnorm

from estimator.components.one_sided import above_zero, cut_at_zero


def test_moments_are_those_of_the_truncated_normal():
    values, sds = above_zero(np.array([-0.7, 0.1, 5.0]), np.array([0.2, 0.5, 1.0]))
    for value, sd, mean, spread in zip([-0.7, 0.1, 5.0], [0.2, 0.5, 1.0], values, sds, strict=True):
        cut = truncnorm(-value / sd, np.inf, loc=value, scale=sd)
        assert (mean, spread) == pytest.approx((cut.mean(), cut.std()), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("size", [-2.0, 0.0, 1.5])
def test_the_other_amplitudes_follow_the_one_that_is_cut(size):
    mean, covariance = np.array([3.0, -1.0, size]), np.array([[2.0, 0.3, 0.8], [0.3, 1.0, -0.5], [0.8, -0.5, 1.0]])
    draws = np.random.default_rng(1).multivariate_normal(mean, covariance, 2_000_000)
    draws = draws[draws[:, 2] > 0]
    found, spread = cut_at_zero(mean, covariance, [2])
    error = 5 / np.sqrt(len(draws))
    assert_allclose(found, draws.mean(axis=0), atol=1.5 * error)
    assert_allclose(spread, np.cov(draws.T), atol=4 * error)


def test_what_is_far_above_zero_is_not_cut():
    mean, covariance = np.array([3.0, 9.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
    for found, given in zip(cut_at_zero(mean, covariance, [1]), (mean, covariance), strict=True):
        assert_allclose(found, given, rtol=1e-9)
