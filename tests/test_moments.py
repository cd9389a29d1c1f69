"""The moment fit on samples whose truth is known."""

import numpy as np
import pytest
from scipy import stats
from scipy.fft import dct
from scipy.signal import lfilter

from estimator.estimation import moments
from estimator.model.road_load import design
from estimator.preparation.kinematics import margin, to_samples
from estimator.preparation.smoothing import smoother_kernels
from estimator.samples import STEP, Rows, Samples

THETA = np.array([1739.0, 3.74, 27_190.0])
SIGMAS = 3.0


def speeds(n: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Speed and acceleration of a drive that speeds up and slows down."""
    t = np.arange(n) * STEP
    waves = [(5.0, 150.0), (2.0, 45.0), (0.8, 17.0)]
    phase = rng.uniform(0, 2 * np.pi, len(waves))
    v = 15 + sum(a * np.sin(2 * np.pi * t / p + f) for (a, p), f in zip(waves, phase, strict=True))
    a = sum(2 * np.pi * a / p * np.cos(2 * np.pi * t / p + f) for (a, p), f in zip(waves, phase, strict=True))
    return v, a


def samples_of(v, a, P, za=None) -> Samples:
    dP = np.gradient(P, STEP)
    return Samples(
        t=np.arange(len(v)) * STEP,
        v=v,
        a=a,
        P=P,
        dP=dP,
        zv=v,
        za=a if za is None else za,
        zdP=dP,
        density=np.full(len(v), np.nan),
    )


def simulated(n: int, rng, sd: float, rho: float, speed_noise: float = 0.0) -> Samples:
    """Samples of a drive whose power has AR(1) errors; regressors and instruments have noise of their own."""
    v, a = speeds(n, rng)
    P = design(v, a) @ THETA
    dP = np.gradient(P, STEP)
    e = lfilter([1.0], [1.0, -rho], rng.standard_normal(n)) * sd * np.sqrt(1 - rho**2)
    noise, other = (speed_noise * rng.standard_normal(n) for _ in range(2))
    return Samples(
        t=np.arange(n) * STEP, v=v, a=a + noise, P=P + e, dP=dP, zv=v, za=a + other, zdP=dP, density=np.full(n, np.nan)
    )


@pytest.mark.parametrize("parameters", [4, 8, 12, 30])
def test_the_spread_of_the_moments_has_more_degrees_of_freedom_than_the_fit_takes(parameters):
    """Of a short drive with slow noise; with twelve the covariance was divided by zero."""
    assert moments._cosines(600, 100.0, parameters) - parameters == moments.MIN_COSINES - moments.PARAMETERS
    assert moments._cosines(100_000, 2.0, parameters) == moments._cosines(100_000, 2.0, 4)


def test_truth_comes_back_without_noise():
    v, a = speeds(6000, np.random.default_rng(1))
    fit = moments.fit(samples_of(v, a, design(v, a) @ THETA + np.random.default_rng(2).normal(0, 1, 6000)), SIGMAS)
    assert fit is not None
    np.testing.assert_allclose(fit.theta[:3], THETA, rtol=1e-3)
    assert fit.rms == pytest.approx(1.0, abs=0.1)


def test_instruments_undo_the_bias_of_least_squares():
    """Noise of dv/dt in the regressor makes the vehicle look lighter; its instrument has noise of its own."""
    s = simulated(20_000, np.random.default_rng(3), sd=5e3, rho=0.9, speed_noise=0.15)
    pulling = s.P > 20e3
    ordinary = np.linalg.lstsq(design(s.v, s.a)[pulling], s.P[pulling], rcond=None)[0]
    fit = moments.fit(s, SIGMAS)
    assert fit is not None
    assert ordinary[2] < 0.93 * THETA[2]
    assert fit.theta[2] == pytest.approx(THETA[2], rel=0.02)
    assert np.all(np.abs(fit.theta[:3] - THETA) < 4 * fit.sd[:3])


@pytest.mark.parametrize("noise", [0.0, 0.008, 0.03])
def test_wheel_speed_noise_does_not_bias(noise):
    """From noisy wheel speed to the fit: what the ring of instruments is for."""
    rng = np.random.default_rng(5)
    v, a = speeds(18_000, rng)
    P = design(v, a) @ THETA
    braking = np.convolve(P < -10e3, np.ones(31), mode="same") > 0.5
    P = np.maximum(P, -10e3) + lfilter([1.0], [1.0, -0.8], rng.normal(0, 1e3, 18_000))
    n = np.arange(18_000)
    rows = Rows(
        index=n, speed=v + rng.normal(0, noise, 18_000), power=P, fresh=np.ones((18_000, 2), dtype=bool), context={}
    )
    samples = to_samples(rows, smoother_kernels(100.0, STEP), 0.0, inertial=False)
    fit = moments.fit(samples[~braking[margin(STEP) : -margin(STEP)]], SIGMAS)
    assert fit is not None
    np.testing.assert_allclose(fit.theta[:3], THETA, rtol=0.03)
    assert fit.theta[2] == pytest.approx(THETA[2], rel=0.01)


@pytest.mark.parametrize("lag", [-0.1, 0.0, 0.15])
def test_a_small_lag_is_absorbed_by_the_nuisance(lag):
    rng = np.random.default_rng(6)
    v, a = speeds(12_000, rng)
    P = design(v, a) @ THETA
    t = np.arange(12_000) * STEP
    late = np.interp(t - lag, t, P) + rng.normal(0, 1e3, 12_000)
    s = samples_of(v, a, late)
    s = Samples(
        t=s.t,
        v=s.v,
        a=s.a,
        P=s.P,
        dP=np.gradient(P, STEP),
        zv=s.zv,
        za=s.za,
        zdP=np.gradient(P, STEP),
        density=s.density,
    )
    fit = moments.fit(s[10:-10], SIGMAS)
    assert fit is not None
    assert fit.theta[3] == pytest.approx(lag, abs=0.02)
    np.testing.assert_allclose(fit.theta[:3], THETA, rtol=0.01)


def test_samples_below_the_noise_do_not_count():
    rng = np.random.default_rng(7)
    s = simulated(12_000, rng, sd=8e3, rho=0.5)
    fit = moments.fit(s, SIGMAS)
    assert fit is not None
    predicted = design(s.zv, s.za) @ fit.theta[:3]
    assert 0.2 < fit.kept.mean() < 0.9
    assert predicted[fit.kept].min() > 2 * 8e3
    assert predicted[~fit.kept].max() < 4 * 8e3


# Data that determine nothing


def noisy(n: int, v, a, rng) -> Samples:
    one = np.ones(n)
    v, a = v * one, a * one
    return samples_of(v, a, design(v, a) @ THETA + rng.normal(0, 1e3, n))


DEGENERATE = {
    "nothing": lambda rng: Samples.concatenate([]),
    "one": lambda rng: noisy(2, 20.0, 0.1, rng)[:1],
    "too few": lambda rng: noisy(79, rng.uniform(5, 20, 79), rng.uniform(-1, 1, 79), rng),
    "constant speed": lambda rng: noisy(3000, 20.0, 0.0, rng),
    "constant speed and acceleration": lambda rng: noisy(3000, 20.0, 0.1, rng),
    "two speeds": lambda rng: noisy(3000, rng.choice([10.0, 20.0], 3000), 0.0, rng),
    "standing": lambda rng: noisy(3000, 0.0, 0.0, rng),
    "no power": lambda rng: samples_of(*speeds(3000, rng), np.zeros(3000)),
    "constant power": lambda rng: samples_of(*speeds(3000, rng), np.full(3000, 1e5)),
    "a proportional to v": lambda rng: noisy(3000, (v := rng.uniform(5, 20, 3000)), 0.01 * v**2, rng),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_data_that_determine_nothing_give_nothing(name):
    assert moments.fit(DEGENERATE[name](np.random.default_rng(8)), SIGMAS) is None


def test_braking_throughout_gives_nothing():
    v, a = speeds(3000, np.random.default_rng(9))
    assert moments.fit(samples_of(v, a, -50e3 + np.random.default_rng(1).normal(0, 1e3, 3000)), SIGMAS) is None


@pytest.mark.parametrize("seed", range(5))
def test_cruise_with_noise_alone_is_never_sure(seed):
    """Noise makes the columns formally independent; the covariance has to say that they are not."""
    rng = np.random.default_rng(seed)
    v, a, zv, za = (m + s * rng.standard_normal(6000) for m, s in ((22, 0.003), (0, 0.02), (22, 0.003), (0, 0.02)))
    P = design(np.full(6000, 22.0), np.zeros(6000)) @ THETA + rng.normal(0, 3e3, 6000)
    dP = rng.normal(0, 1e3, 6000)
    fit = moments.fit(
        Samples(t=np.arange(6000) * STEP, v=v, a=a, P=P, dP=dP, zv=zv, za=za, zdP=dP, density=np.full(6000, np.nan)),
        SIGMAS,
    )
    assert fit is None or fit.sd[2] > 0.1 * THETA[2] or fit.sd[0] > 0.5 * THETA[0]


# The covariance


def test_autocorrelation_time():
    rng = np.random.default_rng(10)
    white = rng.standard_normal(20_000)
    assert moments.autocorrelation_time(white) == pytest.approx(1.0, abs=0.15)
    for rho in (0.5, 0.9):
        red = lfilter([1.0], [1.0, -rho], white)
        assert moments.autocorrelation_time(red) == pytest.approx((1 + rho) / (1 - rho), rel=0.2)
    assert moments.autocorrelation_time(np.ones(100)) == 1.0
    assert moments.autocorrelation_time(np.tile([1.0, -1.0], 50)) == 1.0


def test_long_run_covariance_of_white_and_red_noise():
    rng = np.random.default_rng(11)
    white = rng.standard_normal((20_000, 2)) * [1.0, 3.0]
    np.testing.assert_allclose(np.diag(moments.long_run_covariance(white, 200)) / 20_000, [1, 9], rtol=0.25)
    red = lfilter([1.0], [1.0, -0.9], white, axis=0)
    np.testing.assert_allclose(np.diag(moments.long_run_covariance(red, 200)) / 20_000, [100, 900], rtol=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_intervals_cover(rho):
    """90 % intervals of 200 drives; the seed is fixed, so this is a check of the code and not of luck."""
    rng = np.random.default_rng(12)
    hits = np.zeros(3)
    for _ in range(200):
        fit = moments.fit(simulated(4000, rng, sd=6e3, rho=rho, speed_noise=0.03), SIGMAS)
        assert fit is not None
        hits += np.abs(fit.theta[:3] - THETA) < stats.t(fit.dof).ppf(0.95) * fit.sd[:3]
    assert np.all((hits >= 168) & (hits <= 192)), hits


@pytest.mark.parametrize("n", [24, 25, 1009])
def test_cosine_transforms_are_scipys(n):
    x = np.random.default_rng(n).normal(size=(n, 3))
    expected = dct(x, axis=0, norm="ortho")[1 : n // 2 + 1]
    np.testing.assert_allclose(moments.cosine_transform(x, n // 2), expected, atol=1e-12)
