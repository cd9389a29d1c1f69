"""Kernels against densities known in closed form, diagnostics against ArviZ."""

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy import stats
from scipy.special import logsumexp
from student_target import StudentTarget

from estimator.sampling.convergence import diagnose
from estimator.sampling.identifiability import eigen_metrics
from estimator.sampling.likelihood import in_box
from estimator.sampling.metropolis import KERNELS
from estimator.sampling.run import LONGER, MAX_IMPORTANCE_WEIGHT, MAX_R_HAT, overdispersed, run

CENTRE = np.array([1800.0, 3.7, 27_000.0])
SD = np.array([60.0, 0.1, 90.0])
CORRELATION = np.array([[1, -0.9, -0.2], [-0.9, 1, 0.1], [-0.2, 0.1, 1]])
COVARIANCE = CORRELATION * np.outer(SD, SD)
UNBOUNDED = np.full(3, -np.inf), np.full(3, np.inf)


def student(lower=UNBOUNDED[0], upper=UNBOUNDED[1], dof=30.0):
    return StudentTarget(fitted=CENTRE, covariance=COVARIANCE, dof=dof, lower=lower, upper=upper)


class TwoModes:
    """Two standard normals of equal weight, ``apart`` sd apart along the first axis; the first mode is all it knows."""

    def __init__(self, p, apart):
        self.lower, self.upper = np.full(p, -50.0), np.full(p, 50.0)
        self.centre = np.zeros(p)
        self.modes = np.array([np.zeros(p), apart * np.eye(p)[0]])

    def log_density(self, theta):
        squares = ((theta[:, None, :] - self.modes) ** 2).sum(axis=2)
        return np.where(in_box(theta, self.lower, self.upper), logsumexp(-squares / 2, axis=1), -np.inf)

    def curvature(self, theta):
        return np.broadcast_to(np.eye(len(self.centre)), (len(theta), len(self.centre), len(self.centre)))


def settings(kernel):
    return (64, 20, 250) if kernel == "independence" else (8, 500, 4000)


def test_chains_that_a_box_slows_down_are_made_longer():
    """At the corner of a box 100 draws a chain leave R-hat at 1.05 or more with half of the seeds."""
    covariance = np.array([[1.0, 0.9], [0.9, 1.0]])
    target = StudentTarget(
        fitted=np.array([-2.0, -1.0]), covariance=covariance, dof=50.0, lower=np.zeros(2), upper=np.full(2, 50.0)
    )
    runs = [run(target, "independence", 64, 20, 100, np.random.default_rng(seed)) for seed in range(8)]
    assert {result.draws.shape[1] for result in runs} == {100, 100 * LONGER}
    assert {result.kernel for result in runs} == {"independence"}
    assert all(diagnosis.r_hat < MAX_R_HAT for result in runs for diagnosis in result.diagnoses)
    grid = np.linspace(0, 4, 400)
    theta = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(target.log_density(theta))
    mean = weight @ theta / weight.sum()
    draws = np.concatenate([result.draws.reshape(-1, 2) for result in runs if result.draws.shape[1] > 100])
    np.testing.assert_allclose(draws.mean(axis=0), mean, rtol=0.03)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_draws_from_the_target(kernel):
    rng = np.random.default_rng(7)
    chains, burn_in, draws = settings(kernel)
    starts = CENTRE + 3 * SD * rng.standard_normal((chains, 3))
    result = KERNELS[kernel](student(), starts, burn_in, draws, rng)
    assert result.draws.shape == (chains, draws, 3)
    assert 0.1 < result.acceptance < 0.999
    for i in range(3):
        x = result.draws[:, :, i]
        diagnosis = diagnose(x)
        assert diagnosis.r_hat < 1.02
        assert min(diagnosis.ess_bulk, diagnosis.ess_tail) > 1000
        independent = x.ravel()[:: max(1, round(x.size / diagnosis.ess_bulk))]
        p = stats.kstest((independent - CENTRE[i]) / SD[i], stats.t(30).cdf).pvalue
        assert p > 0.001, (kernel, i)
    correlation = np.corrcoef(result.draws.reshape(-1, 3).T)
    assert np.abs(correlation - CORRELATION).max() < 0.05


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_respects_the_box_exactly(kernel):
    """One standard normal cut at its mean: the half-normal has mean sqrt(2 / pi)."""
    target = StudentTarget(
        fitted=np.zeros(1), covariance=np.eye(1), dof=1e9, lower=np.zeros(1), upper=np.full(1, np.inf)
    )
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


@pytest.mark.parametrize("parameter", range(3))
def test_half_of_the_mass_cut_off_is_no_reason_to_change_the_kernel(parameter):
    lower = UNBOUNDED[0].copy()
    lower[parameter] = CENTRE[parameter]
    result = run(student(lower, dof=1e6), "independence", 64, 20, 400, np.random.default_rng(4))
    assert result.kernel == "independence"
    assert result.acceptance > 0.4
    x = (result.draws[:, :, parameter] - CENTRE[parameter]) / SD[parameter]
    assert stats.kstest(x[:, ::4].ravel(), stats.halfnorm.cdf).pvalue > 0.001
    others = (result.draws - CENTRE).reshape(-1, 3) / SD
    assert others.mean(axis=0) == pytest.approx(CORRELATION[parameter] * np.sqrt(2 / np.pi), abs=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("beyond", [3.0, 30.0])
def test_box_far_from_the_fitted_point(kernel, beyond):
    """The density in the box is the far tail of the fitted Gaussian: close to an exponential along the mass."""
    lower = np.array([-np.inf, -np.inf, CENTRE[2] + beyond * SD[2]])
    target = student(lower, dof=1e9)
    assert target.centre[2] == lower[2]
    starts = overdispersed(target, 64, np.random.default_rng(1))
    assert in_box(starts, target.lower, target.upper).all()
    assert np.isfinite(target.log_density(starts)).all()
    iterations = (20, 400) if kernel == "independence" else (1000, 3000)
    result = run(target, kernel, 64, *iterations, np.random.default_rng(2))
    assert result.kernel == kernel
    assert max(diagnosis.r_hat for diagnosis in result.diagnoses) < 1.02
    tail = stats.truncnorm(beyond, np.inf)
    mass = (result.draws[:, :, 2] - CENTRE[2]) / SD[2]
    assert mass.mean() - beyond == pytest.approx(tail.mean() - beyond, rel=0.05)
    assert mass.std() == pytest.approx(tail.std(), rel=0.08)
    A = (result.draws[:, :, 0] - CENTRE[0]) / SD[0]
    assert A.mean() == pytest.approx(CORRELATION[0, 2] * tail.mean(), abs=0.1)


@pytest.mark.slow
def test_corner_of_the_box():
    """All three parameters held back by their bounds: independent proposals fit badly, the answer is right anyway."""
    target = StudentTarget(
        fitted=np.full(3, -2.0), covariance=np.eye(3), dof=1e9, lower=np.zeros(3), upper=np.full(3, 50.0)
    )
    result = run(target, "independence", 64, 20, 200, np.random.default_rng(2))
    assert max(diagnosis.r_hat for diagnosis in result.diagnoses) < 1.02
    tail = stats.truncnorm(2.0, np.inf)
    assert result.draws.mean(axis=(0, 1)) == pytest.approx(np.full(3, tail.mean() - 2), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("p", [*(pytest.param(p, marks=pytest.mark.nightly) for p in (1, 2)), 3])
def test_two_modes_are_both_found(p):
    result = run(TwoModes(p, 6.0), "independence", 64, 20, 100, np.random.default_rng(p))
    assert result.kernel == "random_walk"
    first = result.draws[:, :, 0]
    assert max(diagnosis.r_hat for diagnosis in result.diagnoses) < 1.05
    assert np.mean(first > 3) == pytest.approx(0.5, abs=0.1)
    assert first.mean() == pytest.approx(3.0, abs=0.6)
    assert first.std() == pytest.approx(np.sqrt(10), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("p", [*(pytest.param(p, marks=pytest.mark.nightly) for p in (1, 2)), 3])
def test_a_proposal_that_hits_a_mode_far_away_is_enough_to_change_the_kernel(p):
    """Nearly all are accepted, and nearly all draws are from the first mode."""
    target = TwoModes(p, 7.0)
    made = KERNELS["independence"](target, np.zeros((256, p)), 20, 100, np.random.default_rng(p))
    assert made.acceptance > 0.9
    assert made.heaviest > MAX_IMPORTANCE_WEIGHT
    assert run(target, "independence", 256, 20, 100, np.random.default_rng(p)).kernel == "random_walk"


def test_importance_weights_of_a_close_proposal_are_alike():
    made = KERNELS["independence"](student(), np.tile(CENTRE, (64, 1)), 20, 100, np.random.default_rng(1))
    assert 1.0 < made.heaviest < 1.5


def test_a_density_with_tails_as_heavy_as_any_here_keeps_its_kernel():
    result = run(student(dof=12.0), "independence", 64, 20, 100, np.random.default_rng(1))
    assert result.kernel == "independence"
    assert min(diagnosis.ess_tail for diagnosis in result.diagnoses) > 3000


def test_long_runs_of_refusals_give_each_mode_its_share():
    """A proposal that knows one of two modes is refused dozens of times in a row in the other."""
    made = KERNELS["independence"](TwoModes(2, 3.5), np.zeros((64, 2)), 1000, 8000, np.random.default_rng(3))
    first = made.draws[:, :, 0]
    repeats = np.all(made.draws[:, 1:] == made.draws[:, :-1], axis=2)
    assert np.diff(np.flatnonzero(~repeats[0])).max() > 20
    assert made.acceptance == pytest.approx(1 - repeats.mean(), abs=1e-3)
    assert np.mean(first > 1.75) == pytest.approx(0.5, abs=0.02)
    assert first.mean() == pytest.approx(1.75, abs=0.06)
    assert first.std() == pytest.approx(np.sqrt(1 + 1.75**2), rel=0.01)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_chains_that_stay_in_different_modes_do_not_count_as_converged(p):
    rng = np.random.default_rng(p)
    target = TwoModes(p, 9.0)
    draws = KERNELS["random_walk"](target, overdispersed(target, 64, rng), 100, 200, rng).draws[:, :, 0]
    shares = np.mean(draws > 4.5, axis=1)
    assert shares.min() == 0 < shares.max()
    assert diagnose(draws).r_hat > 1.1


def test_run_tells_the_correlation():
    result = run(student(), "independence", 64, 20, 250, np.random.default_rng(1))
    assert np.abs(result.correlation - CORRELATION).max() < 0.05


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95, -0.6])
@pytest.mark.parametrize("shape", [(4, 500), (64, 100), (2, 51)])
@pytest.mark.parametrize("ties", [False, True])
def test_diagnostics_agree_with_arviz(rho, shape, ties):
    rng = np.random.default_rng(int(10 * (rho + 1)))
    x = rng.standard_normal(shape)
    for i in range(1, shape[1]):
        x[:, i] = rho * x[:, i - 1] + np.sqrt(1 - rho**2) * x[:, i]
    x[0] += 0.5 * rho
    x = x.round(1) if ties else x
    diagnosis = diagnose(x)
    assert diagnosis.r_hat == pytest.approx(float(array_stats.rhat(x)), rel=1e-6)
    assert diagnosis.ess_bulk == pytest.approx(float(array_stats.ess(x)), rel=1e-6)
    assert diagnosis.ess_tail == pytest.approx(float(array_stats.ess(x, method="tail", prob=(0.05, 0.95))), rel=1e-6)


def test_diagnostics_refuse_what_they_cannot_judge():
    for draws in (np.ones((4, 100)), np.full((4, 100), np.nan), np.random.default_rng(0).normal(size=(1, 100))):
        diagnosis = diagnose(draws)
        assert np.isnan([diagnosis.r_hat, diagnosis.ess_bulk, diagnosis.ess_tail]).all()


def test_eigen_metrics():
    turned = np.radians(30)
    vectors = np.array([[np.cos(turned), np.sin(turned), 0], [-np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    metrics = eigen_metrics(vectors.T @ np.diag([1e6, 1e2, 1e-3]) @ vectors)
    assert metrics.log10_eigenvalues == pytest.approx([6, 2, -3])
    assert metrics.angles == pytest.approx(np.array([[30, 60, 90], [60, 30, 90], [90, 90, 0]]))


def test_scaled_eigen_metrics_do_not_depend_on_units():
    information, units = np.linalg.inv(COVARIANCE), np.array([4.45, 0.2, 14.6])
    metrics = eigen_metrics(information, SD)
    converted = eigen_metrics(information * np.outer(units, units), SD / units)
    assert converted.log10_eigenvalues == pytest.approx(metrics.log10_eigenvalues)
    assert converted.angles == pytest.approx(metrics.angles, abs=1e-4)
    assert metrics.log10_eigenvalues.max() > 1  # A and C are known far better together than apart
    assert metrics.angles[0] == pytest.approx([45, 45, 90], abs=5)


def test_singular_information():
    metrics = eigen_metrics(np.outer([1.0, 2.0, 0.0], [1.0, 2.0, 0.0]))
    assert metrics.log10_eigenvalues == pytest.approx([np.log10(5), -np.inf, -np.inf])
