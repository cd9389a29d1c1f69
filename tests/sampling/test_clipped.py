"""The fast likelihood against the sum over all samples, in extended precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.model.road_load import design
from estimator.sampling.clipped import ClippedGaussianTarget, clipped_least_squares
from estimator.sampling.likelihood import in_box

TRUTH = np.array([1800.0, 3.7, 27_000.0])
LOWER, UPPER = np.zeros(3), np.array([10_000.0, 20.0, 100_000.0])


def drive(kind, n, seed, noise, scale):
    """Samples X, P whose parameters are TRUTH / scale."""
    rng = np.random.default_rng(seed)
    v, a = rng.uniform(0.5, 30, n), rng.normal(0, 0.5, n)
    if kind == "none clipped":
        a = np.abs(a)
    elif kind == "nearly all clipped":
        a[5:] = -np.abs(a[5:]) - 1
    elif kind == "collinear":
        v = 20 + rng.uniform(0.003, 1) * rng.standard_normal(n)
    elif kind == "steady":
        a = 1e-3 * a
    P = np.maximum(design(v, a) @ TRUTH, 0.0) + noise * rng.standard_normal(n)
    return design(v, a) * scale, P


def brute_force(X, P, theta):
    """Chi2 (k,) in extended precision."""
    X, P = X.astype(np.longdouble), P.astype(np.longdouble)
    return np.array([((P - np.maximum(X @ row, 0)) ** 2).sum() for row in theta.astype(np.longdouble)])


kinds = st.sampled_from(["ordinary", "none clipped", "nearly all clipped", "collinear", "steady"])
exponents = st.floats(-6, 6)


@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(kinds, st.integers(10, 5000), st.integers(0, 2**32), st.floats(2, 5), st.tuples(*[exponents] * 3), st.booleans())
def test_fast_chi2_is_exact_everywhere(kind, n, seed, noise, exponents, far_box):
    scale = 10.0 ** np.array(exponents)
    X, P = drive(kind, n, seed, 10.0**noise, scale)
    lower, upper = LOWER / scale, UPPER / scale
    if far_box:
        lower = np.where([True, False, False], 2.5 * TRUTH / scale, lower)
    target = ClippedGaussianTarget(X, P, lower, upper)
    assert ((target.centre >= lower) & (target.centre <= upper)).all()

    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((24, 3))
    z = rng.uniform(0, 8, (24, 1)) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    root = np.linalg.cholesky(target.curvature(target.centre[None])[0])
    least = brute_force(X, P, target.centre[None])

    def errors(theta):
        theta = theta[in_box(theta, lower, upper)]
        exact = (brute_force(X, P, theta) - least) / np.longdouble(target.variance)
        return np.abs(-2 * target.log_density(theta) - exact), np.abs(exact)

    # A double has 16 digits: where chi2 is 1e10 sigma^2, not even its rounding is below 1e-6.
    error, size = errors(target.centre + z @ root.T)
    assert (error <= np.maximum(1e-9, 1e-12 * size)).all()
    error, size = errors(np.vstack([rng.uniform(lower, upper, (16, 3)), lower, upper]))
    assert (error <= np.maximum(1e-6, 1e-12 * size)).all()


def test_log_density_is_that_of_the_sum_over_samples():
    rng = np.random.default_rng(11)
    X, P = rng.normal(size=(50, 3)), rng.normal(size=50)
    target = ClippedGaussianTarget(X, P, np.full(3, -9.0), np.full(3, 9.0))
    theta = rng.normal(size=(4, 3))
    chi2 = [sum((p - max(x @ row, 0.0)) ** 2 for x, p in zip(X, P, strict=True)) for row in [target.centre, *theta]]
    expected = -np.subtract(chi2[1:], chi2[0]) / (2 * target.variance)
    assert target.log_density(theta) == pytest.approx(expected, rel=1e-12)
    assert target.log_density(np.full((1, 3), 10.0))[0] == -np.inf
    assert target.log_density(np.empty((0, 3))).shape == (0,)


def test_curvature_is_that_of_the_active_samples():
    X, P = drive("ordinary", 500, 3, 1e4, 1.0)
    target = ClippedGaussianTarget(X, P, LOWER, UPPER)
    theta = np.array([target.centre, [100.0, 0.1, 90_000.0], [3000.0, 8.0, 15_000.0]])
    for row, covariance in zip(theta, target.curvature(theta), strict=True):
        J = X[X @ row > 0]
        sd = np.sqrt(np.diag(covariance))
        expected = target.variance * np.linalg.inv(J.T @ J)
        assert covariance / np.outer(sd, sd) == pytest.approx(expected / np.outer(sd, sd), abs=1e-3)


def test_least_squares_finds_the_clipped_truth():
    X, P = drive("ordinary", 5000, 1, 0.0, 1.0)
    theta, sums = clipped_least_squares(X, P, LOWER, UPPER)
    assert theta == pytest.approx(TRUTH, rel=1e-6)
    assert sums.n == np.count_nonzero(X @ TRUTH > 0)
    bounded, _ = clipped_least_squares(X, P, LOWER, np.array([1000.0, 20.0, 100_000.0]))
    assert bounded[0] == 1000.0
    assert bounded[1] > TRUTH[1]


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_too_few_samples_leave_the_box(n):
    X, P = drive("none clipped", n, 1, 100.0, 1.0)
    target = ClippedGaussianTarget(X, P, LOWER, UPPER)
    assert np.isfinite(target.log_density(np.array([LOWER, UPPER, TRUTH]))).all()
    assert np.isfinite(target.curvature(TRUTH[None])).all()
