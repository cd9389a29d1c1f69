"""Products in pieces of time against those of the dense covariance."""

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

from estimator.model import gram as module
from estimator.model.gram import gram
from estimator.model.linear_gaussian import Factor, Observations

SIZE, REACH = 90, 5


@pytest.fixture
def pieces(monkeypatch):
    """Twelve pieces of a few unknowns, the last one shorter than the band."""
    monkeypatch.setattr(module, "ELEMENTS", 1)
    monkeypatch.setattr(module, "MIN_PIECE", 8)


def problem(seed, is_dense=True):
    """Precision Q of the unknowns, two kinds of observations in order of time, and columns zero at most times."""
    rng = np.random.default_rng(seed)
    root = np.tril(np.triu(rng.normal(size=(SIZE, SIZE)), -REACH)) + 3 * np.eye(SIZE)
    kinds, A, at = [], [], 0
    for n in (70, 40):
        places = np.sort(rng.integers(0, SIZE - REACH, n))[:, None] + [0, 2, REACH]
        weights = rng.normal(size=(n, 3))
        kinds.append((Observations(places, weights, (REACH + 1, SIZE)), slice(at, at + n)))
        A.append(np.zeros((n, SIZE)))
        A[-1][np.arange(n)[:, None], places] = weights
        at += n
    data = rng.normal(size=(at, 9))
    for column in range(2, 9):  # one run of the first kind, and of the second no more than a few
        data[: 8 * column, column] = data[8 * column + 6 : 70, column] = data[70:, column] = 0.0
    data[80:83, 4] = 1.0
    data[:, 8] = 0.0
    data[:, :2] *= is_dense
    return root @ root.T, np.vstack(A), kinds, rng.uniform(0.5, 2.0, at), data


def precision_band(Q, A, variance):
    """The band of the precision given the data."""
    precision = Q + A.T @ (A / variance[:, None])
    return np.array([np.append(np.diag(precision, -d), np.zeros(d)) for d in range(REACH + 1)])


def products(Q, A, variance, data):
    K = np.diag(variance) + A @ np.linalg.solve(Q, A.T)
    return data.T @ np.linalg.solve(K, data)


@pytest.mark.usefixtures("pieces")
@pytest.mark.parametrize("is_sparse", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_products_in_pieces_are_those_of_the_dense_covariance(is_sparse, seed):
    Q, A, kinds, variance, data = problem(seed)
    factor = Factor.of(precision_band(Q, A, variance))
    found = gram(factor, kinds, variance, sp.csc_array(data) if is_sparse else data)
    assert_allclose(found, products(Q, A, variance, data), rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("pieces")
def test_pieces_in_which_no_column_has_data_are_passed_over():
    Q, A, kinds, variance, data = problem(4, is_dense=False)
    data[:60] = data[70:100] = 0.0
    data[65:68, 3] = data[104:, 5] = 1.0
    found = gram(Factor.of(precision_band(Q, A, variance)), kinds, variance, sp.csc_array(data))
    assert_allclose(found, products(Q, A, variance, data), rtol=1e-9, atol=1e-9)
