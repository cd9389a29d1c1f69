"""The banded linear Gaussian model against the same algebra with dense matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from estimator.model import linear_gaussian
from estimator.model.linear_gaussian import (
    CHUNK,
    MIN_BLOCK,
    Factor,
    NotPositiveDefiniteError,
    Observations,
    add_squares,
    band,
    bandwidth,
    both_triangles,
)

REACH = 3  # places that one observation spans at most


class Problem:
    """A random banded problem, and the dense matrices that it stands for."""

    def __init__(self, seed: int, size: int, n: int, q: int) -> None:
        rng = np.random.default_rng(seed)
        first = rng.integers(0, size, n)
        self.places = np.minimum(first[:, None] + rng.integers(0, REACH + 1, (n, q)), size - 1)
        self.weights = rng.normal(size=(n, q)) * (rng.random((n, q)) > 0.1)
        self.variance = rng.uniform(0.1, 3.0, n)
        self.columns = rng.normal(size=(n, 3))
        self.shape = (REACH + 1, size)
        self.A = np.zeros((n, size))
        np.add.at(self.A, (np.arange(n)[:, None], self.places), self.weights)
        root = np.tril(np.triu(rng.normal(size=(size, size)), -REACH)) + 2 * np.eye(size)
        self.prior = root @ root.T
        self.observations = Observations(self.places, self.weights, self.shape)

    @property
    def K(self):
        """Covariance of the data."""
        return np.diag(self.variance) + self.A @ np.linalg.inv(self.prior) @ self.A.T


problems = st.builds(
    Problem, st.integers(0, 2**32 - 1), size=st.integers(2, 12), n=st.integers(1, 30), q=st.integers(1, 4)
)


def banded(matrix):
    rows, columns = np.nonzero(np.ones_like(matrix))
    near = np.abs(rows - columns) <= REACH
    rows, columns = rows[near], columns[near]
    return band(rows, columns, matrix[rows, columns], (REACH + 1, len(matrix)))


def dense(stored):
    size = stored.shape[1]
    lower = sum(np.diag(stored[d, : size - d], -d) for d in range(min(len(stored), size)))
    return lower + np.tril(lower, -1).T


@given(problems)
def test_a_band_stores_the_lower_triangle_and_bandwidth_says_how_wide_it_must_be(problem):
    assert_allclose(dense(banded(problem.prior)), problem.prior)
    reach = bandwidth(problem.places)
    product = problem.A.T @ problem.A
    assert reach <= REACH
    assert not np.tril(product, -reach - 1).any()


def test_elements_given_twice_add_up_and_those_above_the_diagonal_are_left_out():
    rows, columns = np.array([1, 1, 0]), np.array([0, 0, 1])
    assert_allclose(band(rows, columns, np.array([2.0, 3.0, 7.0]), (2, 2)), [[0, 0], [5, 0]])


def test_no_observations_need_no_band():
    assert bandwidth(np.empty((0, 3), np.int64)) == 0


@given(problems)
def test_information_and_gathered_are_the_dense_products(problem):
    weighted = problem.A / problem.variance[:, None]
    precision = banded(problem.prior)
    problem.observations.add_information(precision, problem.variance)
    assert_allclose(dense(precision), problem.prior + problem.A.T @ weighted, atol=1e-9)
    assert_allclose(problem.observations.gathered(problem.columns), problem.A.T @ problem.columns, atol=1e-12)


@given(problems)
def test_a_factor_solves_whitens_and_has_the_determinant(problem):
    factor = Factor.of(banded(problem.prior))
    right = np.random.default_rng(0).normal(size=(len(problem.prior), 2))
    whitened = factor.whiten(right)
    solved = np.linalg.solve(problem.prior, right)
    doubt = 1e-9 + np.finfo(float).eps * np.linalg.cond(problem.prior)
    assert_allclose(factor.log_determinant, np.linalg.slogdet(problem.prior)[1], rtol=1e-9, atol=doubt)
    assert_allclose(whitened.T @ whitened, right.T @ solved, rtol=1e-6, atol=1e-9)
    assert_allclose(factor.solve(right), solved, rtol=1e-6, atol=1e-9 * np.abs(solved).max())


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(0, 3 * CHUNK))
def test_columns_that_begin_anywhere_are_whitened_as_by_the_dense_factor(seed, size, count):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(size, count)) * (np.arange(size)[:, None] >= rng.integers(0, size + 1, count))
    root = np.tril(np.triu(rng.normal(size=(size, size)), -4)) / 3 + 2 * np.eye(size)
    rows, places = np.nonzero(np.abs(np.subtract.outer(np.arange(size), np.arange(size))) <= 4)
    found = Factor.of(band(rows, places, (root @ root.T)[rows, places], (5, size))).whiten(columns)
    lower = np.linalg.cholesky(root @ root.T)
    assert_allclose(found, np.linalg.solve(lower, columns), rtol=1e-6, atol=1e-9)


@given(problems)
def test_gram_and_determinant_of_the_data_are_those_of_the_dense_covariance(problem):
    observed, variance, Y = problem.observations, problem.variance[:, None], problem.columns
    precision = banded(problem.prior)
    observed.add_information(precision, problem.variance)
    factor = Factor.of(precision)
    whitened = factor.whiten(observed.gathered(Y / variance))
    gram = Y.T @ (Y / variance) - whitened.T @ whitened
    log_k = np.log(variance).sum() + factor.log_determinant - np.linalg.slogdet(problem.prior)[1]
    K = problem.K
    assert_allclose(gram, Y.T @ np.linalg.solve(K, Y), rtol=1e-7, atol=1e-7)
    assert_allclose(log_k, np.linalg.slogdet(K)[1], rtol=1e-8, atol=1e-8)
    n = len(K)
    by_scipy = multivariate_normal(np.zeros(n), K).logpdf(Y[:, 0])
    assert_allclose(-0.5 * (gram[0, 0] + log_k + n * np.log(2 * np.pi)), by_scipy, rtol=1e-7, atol=1e-7)


def test_what_is_not_positive_definite_is_refused():
    with pytest.raises(NotPositiveDefiniteError):
        Factor.of(np.array([[1.0, 1.0], [2.0, 0.0]]))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5 * MIN_BLOCK), st.integers(0, 2 * MIN_BLOCK), st.integers(1, 3))
def test_the_covariance_within_the_band_is_that_of_the_dense_inverse(seed, size, reach, segment):
    rng = np.random.default_rng(seed)
    root = np.tril(np.triu(rng.normal(size=(size, size)), -reach)) / np.sqrt(1 + reach) + 2 * np.eye(size)
    precision = root @ root.T
    rows, columns = np.nonzero(np.abs(np.subtract.outer(np.arange(size), np.arange(size))) <= reach)
    stored = band(rows, columns, precision[rows, columns], (reach + 1, size))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linear_gaussian, "SEGMENT", segment)
        found, expected = Factor.of(stored).covariance(), np.linalg.inv(precision)
    assert found.shape == (reach + 1, size)
    for down in range(min(reach + 1, size)):
        assert_allclose(found[down, : size - down], np.diag(expected, -down), rtol=1e-7, atol=1e-9)


@given(problems)
def test_what_unknowns_add_to_the_variance_of_observations_is_a_product_with_their_covariance(problem):
    covariance = problem.prior  # any positive definite matrix within the band
    found = problem.observations.variance(both_triangles(banded(covariance)))
    assert_allclose(found, np.diag(problem.A @ covariance @ problem.A.T), rtol=1e-9, atol=1e-9)


@given(problems)
def test_squares_of_columns_are_added_within_the_band(problem):
    columns = np.random.default_rng(1).normal(size=(len(problem.prior), 3))
    found = both_triangles(banded(problem.prior))
    add_squares(found, columns)
    assert_allclose(found, both_triangles(banded(problem.prior + columns @ columns.T)))
