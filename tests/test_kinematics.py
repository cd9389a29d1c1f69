"""Kernels are exact where they must be, and what is fitted to the data comes back."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.ndimage import shift as moved

from estimator.model.road_load import design, power
from estimator.preparation.kinematics import margin, to_samples
from estimator.preparation.lag import fit_lag
from estimator.preparation.smoothing import (
    HALF_WIDTH,
    HOLE,
    RATIO_BOUNDS,
    REACH,
    convolve,
    fit_ratio,
    instrument_kernels,
    slow_kernel,
    smoother_kernels,
)
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.units import STANDARD_GRAVITY

THETA = np.array([1739.0, 3.74, 27_190.0])
TRUNCATION = {10.0: 0.2, 100.0: 0.12, 1000.0: 0.02}  # of the slope, by cutting the kernel's tails
RATIOS = list(TRUNCATION)


# Kernels


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("dt", [0.1, 0.05])
def test_smoother_is_exact_for_constants_and_ramps(ratio, dt):
    kernels = smoother_kernels(ratio, dt)
    t = np.arange(100) * dt
    middle = slice(kernels.half, -kernels.half)
    np.testing.assert_allclose(convolve(np.full(100, 7.0), kernels.value)[middle], 7.0)
    np.testing.assert_allclose(convolve(np.full(100, 7.0), kernels.slope)[middle], 0.0, atol=1e-12)
    np.testing.assert_allclose(convolve(3 - 2 * t, kernels.value)[middle], (3 - 2 * t)[middle], atol=1e-12)
    np.testing.assert_allclose(convolve(3 - 2 * t, kernels.slope)[middle], -2.0)


def test_instruments_are_exact_for_cubics():
    kernels = instrument_kernels(STEP)
    t = np.arange(200) * STEP
    cubic, slope = 3 - 2 * t + 0.5 * t**2 - 0.02 * t**3, -2 + t - 0.06 * t**2
    middle = slice(kernels.half, -kernels.half)
    np.testing.assert_allclose(convolve(cubic, kernels.value)[middle], cubic[middle], atol=1e-9)
    np.testing.assert_allclose(convolve(cubic, kernels.slope)[middle], slope[middle], atol=1e-9)


def test_instruments_do_not_touch_what_the_smoother_sees():
    ring = instrument_kernels(STEP)
    lags = np.abs(np.arange(-ring.half, ring.half + 1)) * STEP
    assert not ring.value[lags <= HOLE + 1e-9].any()
    assert not ring.slope[lags <= HOLE + 1e-9].any()
    assert ring.half * STEP == pytest.approx(REACH)
    # A row is the mean of straight lines, so it reaches a period further than its own cell.
    assert HALF_WIDTH + 2 * STEP < HOLE


def test_slow_kernel_keeps_a_constant():
    assert slow_kernel(STEP).sum() == pytest.approx(1.0)
    np.testing.assert_allclose(slow_kernel(STEP), slow_kernel(STEP)[::-1])


@pytest.mark.parametrize("ratio", RATIOS)
def test_smoother_is_that_of_filterpy(ratio):
    dt, n = 0.1, 600
    rng = np.random.default_rng(4)
    speed = 20 + np.cumsum(rng.normal(0, 0.05, n))
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.F = np.array([[1, dt], [0, 1.0]])
    kalman.H = np.array([[1.0, 0]])
    kalman.R *= 0.01**2
    kalman.Q = ratio * 0.01**2 * dt * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    kalman.P = np.diag([1.0, 1.0])
    kalman.x = np.array([[speed[0]], [0.0]])
    means, covariances, _, _ = kalman.batch_filter(speed[:, None])
    smooth = kalman.rts_smoother(means, covariances)[0].reshape(-1, 2)
    kernels = smoother_kernels(ratio, dt)
    middle = slice(80, -80)
    value, slope = (convolve(speed, kernel)[middle] for kernel in (kernels.value, kernels.slope))
    # What the cut tails leave grows with the memory.
    assert np.std(value - smooth[middle, 0]) < 0.01
    assert np.std(slope - smooth[middle, 1]) < TRUNCATION[ratio] * np.std(smooth[middle, 1])


def test_convolve_is_unknown_near_gaps_and_ends():
    kernel = np.ones(5) / 5
    signal = np.ones(30)
    signal[15] = np.nan
    out = convolve(signal, kernel)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(out)), [0, 1, 13, 14, 15, 16, 17, 28, 29])
    assert np.isnan(convolve(np.ones(4), kernel)).all()


# Ratio


def drive_of_random_jerk(ratio: float, n: int, rng) -> np.ndarray:
    """Speed of the model itself, at STEP, with noise of 0.02 m/s."""
    r, dt = 0.02**2, STEP
    q = ratio * r * dt
    noise = np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])) @ rng.standard_normal((2, n))
    a = np.concatenate([[0.0], np.cumsum(noise[1])[:-1]])
    return 15 + np.cumsum(a * dt + noise[0]) + rng.normal(0, 0.02, n)


@pytest.mark.parametrize("ratio", [20.0, 100.0, 600.0])
def test_ratio_comes_back(ratio):
    rng = np.random.default_rng(8)
    fitted = fit_ratio(drive_of_random_jerk(ratio, 4000, rng), STEP)
    assert ratio / 2 < fitted < 2 * ratio


def test_ratio_comes_back_in_pieces():
    rng = np.random.default_rng(9)
    speed = drive_of_random_jerk(100.0, 4000, rng)
    speed[::500] = np.nan
    speed[2000:2400] = np.nan
    assert 40 < fit_ratio(speed, STEP) < 250


@pytest.mark.parametrize(
    "speed",
    [
        np.full(2000, 15.0),
        np.zeros(2000),
        np.full(2000, np.nan),
        np.empty(0),
        np.full(10, 3.0),
        np.random.default_rng(1).normal(15, 0.02, 2000),
        np.cumsum(np.cumsum(np.random.default_rng(1).normal(0, 1, 2000))),
    ],
    ids=["constant", "standing", "unknown", "nothing", "short", "noise", "wild"],
)
def test_ratio_stays_in_bounds(speed):
    assert RATIO_BOUNDS[0] <= fit_ratio(speed, STEP) <= RATIO_BOUNDS[1]


# Lag


def truth(n: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Speed and power of a drive with accelerations up to 1 m/s^2; what the drag of the engine cannot, brakes do."""
    t = np.arange(n) * STEP
    v = 14 + sum(a * np.sin(2 * np.pi * t / p + rng.uniform(0, 6)) for a, p in ((4, 60), (1.5, 17), (0.4, 5)))
    return v, np.maximum(design(v, np.gradient(v, STEP)) @ THETA, -15e3)


@pytest.mark.parametrize("lag", [-0.5, -0.23, -0.1, 0.0, 0.04, 0.3, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_lag_comes_back(lag, seed):
    rng = np.random.default_rng(seed)
    v, P = truth(3000, rng)
    late = moved(P, lag / STEP, order=3, mode="nearest") + rng.normal(0, 3e3, len(P))
    assert fit_lag(v + rng.normal(0, 0.01, len(v)), late, STEP, 0.6) == pytest.approx(lag, abs=0.03)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_noise_has_no_lag(seed, correlation):
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(1800)
    for i in range(1, len(noise)):
        noise[i] += correlation * noise[i - 1]
    speed = 20 + np.cumsum(rng.normal(0, 0.05, 1800))
    assert fit_lag(speed, 1e5 + 1e4 * noise, STEP, 0.6) == 0.0


def test_lag_is_zero_where_nothing_can_tell():
    v, P = truth(3000, np.random.default_rng(1))
    unknown = np.full(3000, np.nan)
    for speed, load in ((np.zeros(3000), P), (v, unknown), (unknown, P), (v, np.full(3000, 1e5)), (v, np.zeros(3000))):
        assert fit_lag(speed, load, STEP, 0.6) == 0.0
    assert fit_lag(v[:200], P[:200], STEP, 0.6) == 0.0


def test_lag_stays_within_what_is_searched():
    v, P = truth(3000, np.random.default_rng(2))
    for longest in (0.0, 0.2, 2.0):
        for shift in (-25, -3, 3, 25):
            assert abs(fit_lag(v, np.roll(P, shift), STEP, longest)) <= longest


# Samples


def rows(v, P, **context) -> Rows:
    n = len(v)
    roles = {Role(name): value for name, value in context.items()}
    return Rows(index=np.arange(n, dtype=np.int64), speed=v, power=P, fresh=np.ones((n, 2), dtype=bool), context=roles)


def test_samples_obey_the_model_on_both_sides():
    v, P = truth(3000, np.random.default_rng(3))
    samples = to_samples(rows(v, P), smoother_kernels(100.0, STEP), 0.0, inertial=False)
    assert len(samples) == 3000 - 2 * margin(STEP)
    np.testing.assert_allclose(samples.t, np.arange(margin(STEP), 3000 - margin(STEP)) * STEP)
    pulling = np.convolve(P > 0, np.ones(41), mode="same")[margin(STEP) : -margin(STEP)] > 40.5
    model = power(samples.v, samples.a, THETA)
    assert np.std((model - samples.P)[pulling]) < 0.03 * np.std(samples.P[pulling])
    assert np.corrcoef(samples.a, samples.za)[0, 1] > 0.9
    assert np.corrcoef(samples.dP, samples.zdP)[0, 1] > 0.5


@pytest.mark.parametrize("lag", [-1.23, -0.2, 0.15, 0.4, 2.0])
def test_samples_undo_the_lag(lag):
    v, P = truth(3000, np.random.default_rng(3))
    kernels = smoother_kernels(100.0, STEP)
    straight = to_samples(rows(v, P), kernels, 0.0, inertial=False)
    late = to_samples(rows(v, moved(P, lag / STEP, order=3, mode="nearest")), kernels, lag, inertial=False)
    assert np.isfinite(late.zdP).all()
    np.testing.assert_allclose(late.P, straight.P, atol=0.01 * np.ptp(straight.P))


def test_inertial_acceleration_senses_the_grade():
    v, P = truth(3000, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    sine = 0.02 * np.sin(2 * np.pi * np.arange(3000) * STEP / 120)
    sensed = np.gradient(v, STEP) + STANDARD_GRAVITY * sine + rng.normal(0, 0.05, 3000)
    kernels = smoother_kernels(100.0, STEP)
    flat = to_samples(rows(v, P), kernels, 0.0, inertial=False)
    felt = to_samples(rows(v, P, longitudinal_acceleration=sensed), kernels, 0.0, inertial=True)
    gravity = (STANDARD_GRAVITY * sine)[margin(STEP) : -margin(STEP)]
    np.testing.assert_allclose(felt.a - flat.a, gravity, atol=0.03)
    np.testing.assert_allclose(felt.za - flat.za, gravity, atol=0.03)
    np.testing.assert_array_equal(felt.v, flat.v)


def test_inertial_without_its_sensor_knows_nothing():
    v, P = truth(300, np.random.default_rng(3))
    assert np.isnan(to_samples(rows(v, P), smoother_kernels(100.0, STEP), 0.0, inertial=True).a).all()
