"""Kernels against densities known in closed form, diagnostics against ArviZ."""

import arviz
import numpy as np
import pytest
from scipy import stats

from estimator.sampling import convergence
from estimator.sampling.likelihood import ClippedGaussianTarget, StudentTarget
from estimator.sampling.metropolis import KERNELS

CENTRE = np.array([1800.0, 3.7, 27_000.0])
SD = np.array([60.0, 0.1, 90.0])
CORRELATION = np.array([[1, -0.9, -0.2], [-0.9, 1, 0.1], [-0.2, 0.1, 1]])
COVARIANCE = CORRELATION * np.outer(SD, SD)


def student(lower: float = -np.inf) -> StudentTarget:
    return StudentTarget(CENTRE, COVARIANCE, 30.0, np.full(3, lower), np.full(3, np.inf))


def settings(kernel: str) -> tuple[int, int, int]:
    return (64, 20, 250) if kernel == "independence" else (8, 500, 4000)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_draws_from_the_target(kernel):
    rng = np.random.default_rng(7)
    chains, burn_in, draws = settings(kernel)
    starts = CENTRE + 3 * SD * rng.standard_normal((chains, 3))
    result = KERNELS[kernel](student(), starts, burn_in, draws, rng)
    assert result.draws.shape == (chains, draws, 3)
    assert 0.1 < result.acceptance < 0.97
    for i in range(3):
        x = result.draws[:, :, i]
        assert convergence.r_hat(x) < 1.02
        ess = convergence.ess_bulk(x)
        assert ess > 1000
        independent = x.ravel()[:: max(1, round(x.size / ess))]
        p = stats.kstest((independent - CENTRE[i]) / SD[i], stats.t(30).cdf).pvalue
        assert p > 0.001, (kernel, i)
    correlation = np.corrcoef(result.draws.reshape(-1, 3).T)
    assert np.abs(correlation - CORRELATION).max() < 0.05


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_respects_the_box_exactly(kernel):
    """One standard normal cut at its mean: the half-normal has mean sqrt(2 / pi)."""
    target = StudentTarget(np.zeros(1), np.eye(1), 1e9, np.zeros(1), np.full(1, np.inf))
    rng = np.random.default_rng(3)
    chains, burn_in, draws = settings(kernel)
    x = KERNELS[kernel](target, np.full((chains, 1), 0.5), burn_in, draws, rng).draws
    assert x.min() >= 0
    assert x.mean() == pytest.approx(np.sqrt(2 / np.pi), abs=0.04)
    assert x.std() == pytest.approx(np.sqrt(1 - 2 / np.pi), abs=0.04)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_is_reproducible(kernel):
    starts = np.tile(CENTRE, (4, 1))
    a, b = (KERNELS[kernel](student(), starts, 10, 50, np.random.default_rng(5)).draws for _ in range(2))
    assert np.array_equal(a, b)


def test_clipped_target_is_the_sum_over_samples():
    rng = np.random.default_rng(11)
    X = rng.normal(size=(50, 3))
    P = rng.normal(size=50)
    target = ClippedGaussianTarget(X, P, np.zeros(3), 0.5, np.full(3, -9.0), np.full(3, 9.0))
    theta = rng.normal(size=(4, 3))
    expected = [-sum((p - max(x @ th, 0.0)) ** 2 for x, p in zip(X, P, strict=True)) / (2 * 0.5) for th in theta]
    assert target.log_density(theta) == pytest.approx(expected, rel=1e-12)
    assert target.log_density(np.full((1, 3), 10.0))[0] == -np.inf


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95, -0.6])
@pytest.mark.parametrize("shape", [(4, 500), (64, 100), (2, 51)])
def test_diagnostics_agree_with_arviz(rho, shape):
    rng = np.random.default_rng(int(10 * (rho + 1)))
    x = rng.standard_normal(shape)
    for i in range(1, shape[1]):
        x[:, i] = rho * x[:, i - 1] + np.sqrt(1 - rho**2) * x[:, i]
    x[0] += 0.5 * rho
    assert convergence.r_hat(x) == pytest.approx(float(arviz.rhat(x)), rel=1e-6)
    assert convergence.ess_bulk(x) == pytest.approx(float(arviz.ess(x)), rel=1e-6)
    assert convergence.ess_tail(x) == pytest.approx(float(arviz.ess(x, method="tail")), rel=1e-6)


def test_diagnostics_refuse_what_they_cannot_judge():
    assert np.isnan(convergence.r_hat(np.ones((4, 100))))
    assert np.isnan(convergence.ess_bulk(np.full((4, 100), np.nan)))
    assert np.isnan(convergence.r_hat(np.random.default_rng(0).normal(size=(1, 100))))
