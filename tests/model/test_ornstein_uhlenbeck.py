"""The Ornstein-Uhlenbeck chain against its covariance, and means between its ends against their moments."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from estimator.model.ornstein_uhlenbeck import Chain, mean_given_ends, mean_given_ends_by_time


def covariance(t, linked, variance, time):
    stretch = np.concatenate([[0], np.cumsum(~linked)])
    together = stretch[:, None] == stretch
    return variance * np.exp(-np.abs(t[:, None] - t) / time) * together


def precision(chain, size, width, variance, time):
    """Dense precision, and the log determinant that the chain says it has."""
    target = np.zeros((width, size))
    log_determinant = chain.add_precision(target, np.sqrt(variance), time)
    lower = sum(np.diag(target[d, : size - d], -d) for d in range(width))
    return lower + np.tril(lower, -1).T, log_determinant


chains = st.lists(st.tuples(st.floats(0.05, 20.0), st.booleans()), min_size=1, max_size=25)


@given(chains, st.floats(1e-3, 1e3), st.floats(0.2, 50.0))
def test_the_chain_is_the_inverse_of_the_exponential_covariance(steps, variance, time):
    t = np.concatenate([[0.0], np.cumsum([dt for dt, _ in steps])])
    linked = np.array([link for _, link in steps])
    n = len(t)
    found, log_determinant = precision(Chain(t, np.arange(n), linked), n, 2, variance, time)
    K = covariance(t, linked, variance, time)
    assert_allclose(found @ K, np.eye(n), atol=1e-7)
    assert log_determinant == pytest.approx(-np.linalg.slogdet(K)[1], rel=1e-7, abs=1e-7)


def test_other_unknowns_may_stand_between_and_what_was_there_stays():
    t, linked, places = np.array([0.0, 1.0, 3.0, 3.5]), np.array([True, False, True]), np.array([1, 3, 4, 6])
    target = np.full((4, 8), 0.25)
    before = target.copy()
    Chain(t, places, linked).add_precision(target, np.sqrt(2.0), 1.5)
    added = target - before
    lower = sum(np.diag(added[d, : 8 - d], -d) for d in range(4))
    dense = lower + np.tril(lower, -1).T
    expected = np.zeros((8, 8))
    expected[np.ix_(places, places)] = np.linalg.inv(covariance(t, linked, 2.0, 1.5))
    assert_allclose(dense, expected, atol=1e-12)


def test_stretches_that_are_not_linked_are_independent():
    t, linked = np.array([0.0, 0.1, 0.2, 0.3]), np.array([True, False, True])
    found, _ = precision(Chain(t, np.arange(4), linked), 4, 2, 1.0, 10.0)
    K = np.linalg.inv(found)
    assert not K[:2, 2:].any()
    assert K[0, 1] == pytest.approx(np.exp(-0.01))


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.05, 0.3, 1.0, 5.0, 60.0])
@pytest.mark.parametrize("length", [1.0, 2.5])
def test_the_mean_between_two_ends_has_the_moments_of_a_fine_grid(length, time):
    # The mean by the trapezoid rule over a fine grid, regressed on the values at both ends.
    n = 2001
    t = np.linspace(0, length, n)
    K = np.exp(-np.abs(t[:, None] - t) / time)
    share = np.full(n, 1 / (n - 1))
    share[[0, -1]] /= 2
    ends = K[np.ix_([0, -1], [0, -1])]
    with_ends = share @ K[:, [0, -1]]
    weights = np.linalg.solve(ends, with_ends)
    left = share @ K @ share - with_ends @ weights
    weight, own = mean_given_ends(length, time)
    # The trapezoid rule of a function with a kink on the diagonal is exact to (step / time)^2 / 6.
    tolerance = (t[1] / time) ** 2
    assert weights == pytest.approx([weight, weight], rel=1e-9 + tolerance)
    assert own == pytest.approx(left, rel=1e-6 + 10 * tolerance)


def test_a_long_memory_makes_the_mean_that_of_both_ends():
    weight, own = mean_given_ends(1.0, 1e4)
    assert weight == pytest.approx(0.5)
    assert 0 < own < 1e-4


@pytest.mark.parametrize("time", [0.05, 0.3, 1.0, 5.0, 60.0])
def test_the_change_of_the_mean_with_the_memory_is_a_difference_of_two(time):
    step = 1e-4
    (more, own_more), (less, own_less) = (mean_given_ends(1.0, time * np.exp(sign * step)) for sign in (1, -1))
    by_weight, by_own = mean_given_ends_by_time(1.0, time)
    assert by_weight == pytest.approx(np.log(more / less) / (2 * step), rel=1e-5, abs=1e-9)
    assert by_own == pytest.approx((own_more - own_less) / (2 * step), rel=1e-3, abs=1e-7)


@pytest.mark.slow
@given(chains, st.floats(0.1, 10.0), st.floats(0.5, 50.0))
def test_score_and_response_are_derivatives_of_the_dense_gaussian(steps, sd, time):
    t = np.concatenate([[0.0], np.cumsum([dt for dt, _ in steps])])
    linked, n, rng = np.array([link for _, link in steps]), len(steps) + 1, np.random.default_rng(3)
    chain, places = Chain(t, 2 * np.arange(n), linked), 2 * np.arange(n)  # others stand between
    products = rng.normal(size=(n, n))
    products = products @ products.T
    stored = np.zeros((3, 2 * n))
    stored[0, places], stored[2, places[:-1]] = np.diag(products), 2 * np.diag(products, -1)
    x, step = rng.normal(size=n), 1e-5
    found, response = chain.score(stored, sd, time), chain.response(x, sd, time)
    K = covariance(t, linked, sd**2, time)
    for i, (by_sd, by_time) in enumerate(((step, 0.0), (0.0, step))):
        ends = [covariance(t, linked, sd**2 * np.exp(2 * s * by_sd), time * np.exp(s * by_time)) for s in (1, -1)]
        change = (ends[0] - ends[1]) / (2 * step)
        inverse = np.linalg.inv(K)
        expected = 0.5 * np.trace(inverse @ change @ (inverse @ products - np.eye(n)))
        assert found[i] == pytest.approx(expected, rel=1e-4, abs=1e-5 * (1 + np.abs(inverse @ products).max()))
        assert_allclose(response[:, i], change @ inverse @ x, rtol=1e-4, atol=1e-5 * np.abs(x).max())
