"""The Markov field along the road against dense matrices, and against the covariance of a Matern process."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.special import gamma, kv

from estimator.model.matern import MaternField, _inverse_diagonal


def matern(distance, nu, sd, length):
    """The covariance of Rasmussen & Williams (2006), equation 4.14."""
    x = np.maximum(np.sqrt(2 * nu) * np.abs(distance) / length, 1e-9)
    return sd**2 * 2 ** (1 - nu) / gamma(nu) * x**nu * kv(nu, x)


def precision_and_determinant(field, size, width, sd, length):
    target = np.zeros((width, size))
    log_determinant = field.add_precision(target, sd, length)
    lower = sum(np.diag(target[d, : size - d], -d) for d in range(min(width, size)))
    return lower + np.tril(lower, -1).T, log_determinant


def precision(*arguments):
    return precision_and_determinant(*arguments)[0]


def by_the_formula(nodes, joined, alpha, sd, length):
    """Q = tau L (M^-1 L)^(alpha - 1), assembled element by element."""
    n = len(nodes)
    M, G = np.zeros((n, n)), np.zeros((n, n))
    for k in np.flatnonzero(joined):
        width = nodes[k] - nodes[k - 1]
        pair = np.ix_([k - 1, k], [k - 1, k])
        M[pair] += np.eye(2) * width / 2
        G[pair] += np.array([[1, -1], [-1, 1]]) / width
    M[np.diag_indices(n)] += np.where(np.diag(M) == 0, 1.0, 0.0)  # a node alone
    nu = alpha - 0.5
    kappa = sqrt(2 * nu) / length
    tau = gamma(nu) / (gamma(alpha) * sqrt(4 * np.pi) * kappa ** (2 * nu) * sd**2)
    L = kappa**2 * M + G
    Q = L
    for _ in range(alpha - 1):
        Q = L @ np.linalg.solve(M, Q)
    return tau * Q


stretches = st.lists(st.tuples(st.floats(5.0, 50.0), st.booleans()), min_size=1, max_size=14)


@pytest.mark.slow
@given(stretches, st.sampled_from([2, 3, 4]), st.floats(1e-3, 1.0), st.floats(50.0, 500.0))
def test_precision_and_determinant_are_those_of_the_formula(steps, alpha, sd, length):
    nodes = np.concatenate([[0.0], np.cumsum([step for step, _ in steps])])
    joined = np.array([False, *(join for _, join in steps)])
    n = len(nodes)
    field = MaternField(nodes, joined, alpha, np.arange(n), (alpha + 1, n))
    expected = by_the_formula(nodes, joined, alpha, sd, length)
    found, log_determinant = precision_and_determinant(field, n, alpha + 1, sd, length)
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    # The determinant of the dense matrix itself is exact to its condition only.
    unit = 1 / np.sqrt(np.diag(expected))
    scaled = expected * np.outer(unit, unit)
    dense = np.linalg.slogdet(scaled)[1] - 2 * np.log(unit).sum()
    doubt = n * np.finfo(float).eps * np.linalg.cond(scaled)
    assert log_determinant == pytest.approx(dense, rel=1e-9, abs=1e-6 + doubt)


@pytest.mark.parametrize(("alpha", "tolerance"), [(2, 0.03), (3, 0.03), (4, 0.03)])
@pytest.mark.parametrize("length", [200.0, 600.0])
def test_far_from_the_ends_the_covariance_is_that_of_a_matern_process(alpha, tolerance, length):
    sd, spacing = 0.01, 25.0
    nodes = spacing * np.arange(401)
    field = MaternField(nodes, np.arange(401) > 0, alpha, np.arange(401), (alpha + 1, 401))
    K = np.linalg.inv(precision(field, 401, alpha + 1, sd, length))
    middle = slice(160, 241)
    expected = matern(nodes[middle] - nodes[200], alpha - 0.5, sd, length)
    assert_allclose(K[200, middle], expected, atol=tolerance * sd**2)
    assert K[200, 200] == pytest.approx(sd**2, rel=tolerance)


def test_halving_the_spacing_brings_the_covariance_nearer_to_the_matern_process():
    def error(spacing):
        nodes = np.arange(0.0, 6000.0 + spacing, spacing)
        n = len(nodes)
        field = MaternField(nodes, np.arange(n) > 0, 2, np.arange(n), (3, n))
        K = np.linalg.inv(precision(field, n, 3, 1.0, 300.0))
        return abs(K[n // 2, n // 2] - 1.0)

    assert error(12.5) < 0.4 * error(25.0) < 0.16 * error(50.0)


@pytest.mark.parametrize("alpha", [2, 4])
def test_at_a_free_end_the_variance_is_twice_that_of_the_middle(alpha):
    nodes = 25.0 * np.arange(201)
    field = MaternField(nodes, np.arange(201) > 0, alpha, np.arange(201), (alpha + 1, 201))
    K = np.linalg.inv(precision(field, 201, alpha + 1, 0.01, 300.0))
    assert K[0, 0] / K[100, 100] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("alpha", [2, 3, 4])
def test_stretches_that_are_not_joined_are_independent(alpha):
    nodes = np.concatenate([25.0 * np.arange(20), 480.0 + 25.0 * np.arange(15), [9000.0]])
    joined = np.ones(36, bool)
    joined[[0, 20, 35]] = False
    places = np.arange(36)
    whole = precision(MaternField(nodes, joined, alpha, places, (alpha + 1, 36)), 36, alpha + 1, 0.01, 300.0)
    assert not whole[:20, 20:].any()
    assert not whole[20:35, 35:].any()
    alone = MaternField(nodes[:20], joined[:20], alpha, np.arange(20), (alpha + 1, 20))
    assert_allclose(precision(alone, 20, alpha + 1, 0.01, 300.0), whole[:20, :20])


def test_nodes_among_other_unknowns_take_their_places():
    nodes, joined = 25.0 * np.arange(6), np.arange(6) > 0
    places = np.array([1, 2, 5, 6, 8, 11])
    spread = MaternField(nodes, joined, 2, places, (7, 13))
    found = precision(spread, 13, 7, 0.02, 100.0)
    assert_allclose(found[np.ix_(places, places)], by_the_formula(nodes, joined, 2, 0.02, 100.0), rtol=1e-9)
    others = np.setdiff1d(np.arange(13), places)
    assert not found[others].any()


def test_a_node_alone_has_a_precision_of_its_own():
    alone = np.zeros(1), np.zeros(1, bool)
    field = MaternField(*alone, 4, np.zeros(1, np.int64), (5, 1))
    found, log_determinant = precision_and_determinant(field, 1, 5, 0.01, 300.0)
    assert found == pytest.approx(by_the_formula(*alone, 4, 0.01, 300.0))
    assert log_determinant == pytest.approx(np.log(found[0, 0]))


@pytest.mark.slow
@given(stretches, st.sampled_from([2, 3, 4]), st.floats(1e-2, 1.0), st.floats(50.0, 300.0))
def test_score_and_response_are_derivatives_of_the_dense_gaussian(steps, alpha, sd, length):
    nodes = np.concatenate([[0.0], np.cumsum([step for step, _ in steps])])
    joined = np.array([False, *(join for _, join in steps)])
    n, rng, step = len(nodes), np.random.default_rng(5), 1e-5
    field = MaternField(nodes, joined, alpha, np.arange(n), (alpha + 1, n))
    Q = by_the_formula(nodes, joined, alpha, sd, length)
    root = rng.normal(size=(n, n)) * sd
    products = root @ root.T
    stored = np.zeros((alpha + 1, n))
    for down in range(min(alpha + 1, n)):
        stored[down, : n - down] = np.diag(products, -down) * (1 if down == 0 else 2)
    x = sd * rng.normal(size=n)
    found, response = field.score(stored, sd, length), field.response(x, sd, length)
    for i, (by_sd, by_length) in enumerate(((step, 0.0), (0.0, step))):
        ends = [
            by_the_formula(nodes, joined, alpha, sd * np.exp(s * by_sd), length * np.exp(s * by_length))
            for s in (1, -1)
        ]
        change = (ends[0] - ends[1]) / (2 * step)
        each = np.linalg.solve(Q, change)  # V' = -V Q' V
        expected = 0.5 * (np.trace(each) - np.trace(change @ products))
        doubt = 1e-4 + np.finfo(float).eps * np.linalg.cond(Q) / step  # differences of the dense matrix are as exact
        assert found[i] == pytest.approx(expected, rel=1e-3, abs=doubt * (1 + np.abs(np.trace(Q @ products))))
        assert_allclose(response[:, i], -each @ x, rtol=1e-3, atol=doubt * np.abs(x).max())


@pytest.mark.parametrize("size", [2, 3, 40])
def test_the_diagonal_of_an_inverse_follows_from_the_pivots_of_both_sides(size):
    rng = np.random.default_rng(size)
    off = -rng.uniform(0.5, 1.0, size)
    diagonal = 0.01 - off - np.roll(off, 1)
    dense = np.diag(diagonal) + np.diag(off[:-1], 1) + np.diag(off[:-1], -1)
    assert_allclose(_inverse_diagonal(diagonal, off), np.diag(np.linalg.inv(dense)))
