"""The plain model, places, formulas and surrogates of the diagnosis against analytic and brute-force values."""

from dataclasses import replace

import numpy as np
import pytest
from diagnoses import finding
from driven_on_level_road import THETA, driven
from scipy.stats import false_discovery_control

from estimator.components.budget import ROAD, Residuals
from estimator.components.plain_model import PlainModel
from estimator.diagnosis import localisation
from estimator.diagnosis.findings import of_aligned_power, of_shown_road
from estimator.diagnosis.residual_formula import best_residual_formula
from estimator.diagnosis.result import GapClosed, Traces
from estimator.diagnosis.surrogates import phase_randomised
from estimator.estimation.long_run import long_run_variance
from estimator.false_discovery import false_discovery_rates
from estimator.signals import Floats, Quantity

NOISE = 1e3  # W, sd of the power of a row of 2 s
STEP = 2.0  # s of a row


def traces_of(extra: Floats | float = 0.0, minutes: float = 20.0, seed: int = 1) -> Traces:
    """A drive on a flat road with white noise of the power, and ``extra`` power [W]."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 60.0 * minutes, STEP)
    v = 18 + 6 * np.sin(2 * np.pi * t / 190) + 2 * np.sin(2 * np.pi * t / 47)
    a = np.gradient(v, STEP)
    base = THETA[0] * v + THETA[1] * v**3 + THETA[2] * v * a
    measured = base + extra + rng.normal(0.0, NOISE, len(t))
    return Traces(
        t=t,
        distance=np.cumsum(v) * STEP,
        speed=v,
        acceleration=a,
        measured=measured,
        base=base,
        extended=base,
        road_known=base,
        log=np.zeros(len(t)),
    )


# The plain model


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_long_run_variance_of_an_autoregression(rho: float) -> None:
    """Of the sum of n values: n s^2 / (1 - rho)^2 with innovations of variance s^2 (Hamilton 1994, section 7.2)."""
    rng = np.random.default_rng(3)
    n, k = 2000, 200
    noise = rng.normal(size=(n + 200, k))
    for i in range(1, len(noise)):
        noise[i] += rho * noise[i - 1]
    variance, dof = np.transpose([long_run_variance(column) for column in noise[200:].T])
    assert variance.mean() == pytest.approx(n / (1 - rho) ** 2, rel=0.1)
    assert np.var(variance / variance.mean()) == pytest.approx(np.mean(2 / dof), rel=0.6)


def test_the_plain_model_is_least_squares_of_the_power_at_the_strides() -> None:
    fit = driven().fit
    plain, s = PlainModel(fit), fit.strides
    force = s.force[:, 0]  # the same at every lag: the column of the lag is zero
    X = np.column_stack([s.a, np.ones(len(s)), s.speed_squared, np.minimum(force, 0.0)]) * s.speed[:, None]
    m, A, C, _ = np.linalg.lstsq(X, plain.power, rcond=None)[0].tolist()
    road_load, sd = plain.road_load
    assert road_load.tolist() == pytest.approx([A, C, m], rel=1e-6)
    assert np.all(np.abs(road_load - THETA) < 5 * sd)
    left = plain.residual(plain.power)
    again = plain.residual(plain.power + X @ np.array([1e3, -20.0, 0.3, 0.1]))
    assert again == pytest.approx(left, abs=1e-4)  # what the columns can imitate is no residual


def test_a_plain_model_of_a_steady_drive_is_not_determined() -> None:
    fit = driven().fit
    n = len(fit.strides)
    steady = replace(
        fit.strides,
        a=np.full(n, 0.01),
        v0=np.full(n, 20.0),
        v1=np.full(n, 20.0),
        speed_squared=np.full(n, 400.0),
    )
    assert PlainModel(fit).is_determined
    assert not PlainModel(replace(fit, strides=steady)).is_determined


# Shares of the gap


@pytest.mark.parametrize(("others", "by_lag"), [((1.0,), 0.8), ((0.5, 0.5), 0.8), ((), 1.0)])
def test_a_lag_and_the_effects_beside_it_share_the_gap_by_what_they_take(others: tuple[float, ...], by_lag: float):
    lag = replace(finding("time_lag", 1.0), rms_before=5e3, rms_after=np.sqrt(5.8e6))
    lag = replace(lag, gap_closed=GapClosed(1.0, 0.9, 1.0))
    found = [finding("drafting", 0.99, gap_closed=GapClosed(share, 0.9 * share, share)) for share in others]
    *beside, last = of_aligned_power(found, lag, 1e3)  # from 25 to 5.8 MW^2 by the lag, then to 1 MW^2
    assert last.gap_closed.fraction == pytest.approx(by_lag)
    assert last.gap_closed.q05 == pytest.approx(0.9 * by_lag)
    assert [f.gap_closed.fraction for f in beside] == pytest.approx([0.2 * share for share in others])
    assert sum(f.gap_closed.fraction for f in (*beside, last)) == pytest.approx(1.0)


def test_the_interval_of_a_road_that_signals_show_holds_what_they_show_of_longer_drives() -> None:
    """The road is white; the signals err by a third of it, which leaves a ninth of its square."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(200):
        road, noise = rng.normal(size=(2, 600))
        error = np.repeat(rng.normal(size=20), 30) / 3
        r = road + 0.1 * noise
        left = r - (road - error)
        shown = float((np.mean(r**2) - np.mean(left**2)) / (np.mean(r**2) - np.mean((r - road) ** 2)))
        residuals = Residuals(plain=r, given=r, held_out=left, road_known=r - road, causes={ROAD: road - error})
        found.append(of_shown_road((1.0, 1.0, 1.0), shown, [residuals]))
        assert found[-1].fraction == pytest.approx(shown)
    assert all(closed.q05 < closed.fraction < closed.q95 <= 1.0 for closed in found)
    assert np.mean([closed.q05 <= 1 - 1 / 9 <= closed.q95 for closed in found]) == pytest.approx(0.88, abs=0.05)


def test_a_road_that_signals_show_whole_closes_no_more_than_all() -> None:
    road = np.random.default_rng(1).normal(size=100)
    residuals = Residuals(plain=road, given=road, held_out=0 * road, road_known=0 * road, causes={ROAD: road})
    closed = of_shown_road((0.9, 0.8, 1.0), 1.01, [residuals])
    assert (closed.fraction, closed.q95) == (0.9, 1.0)
    assert closed.q05 == pytest.approx(0.8, abs=0.01)


# Places


def test_nothing_is_located_where_there_is_only_noise() -> None:
    """False discoveries are held at 5 % over all parts: at most two of 30 clean drives show any."""
    assert sum(bool(localisation.biased_parts(traces_of(seed=seed), {})) for seed in range(30)) <= 2


def test_a_load_is_located_in_time_with_its_bias_and_share() -> None:
    t = np.arange(0.0, 1200.0, STEP)
    on = (t >= 450.0) & (t < 600.0)  # the fourth of eight parts
    traces = traces_of(40e3 * on)
    traces = replace(traces, t=traces.t + 30.0)  # of the first row used, since the first frame
    residual = traces.measured - traces.base
    found = localisation.biased_parts(traces, {})
    (place,) = [p for p in found if p.axis == "time" and p.bias == max(q.bias for q in found if q.axis == "time")]
    assert (place.start, place.end) == (pytest.approx(480.0, abs=STEP), pytest.approx(630.0, abs=STEP))
    assert place.bias == pytest.approx(residual[on].mean(), rel=0.02)
    assert place.share == pytest.approx(on.sum() * residual[on].mean() ** 2 / (residual @ residual), rel=0.02)
    assert place.q_value < 1e-3
    shares = [p.share for p in found]
    assert shares == sorted(shares, reverse=True)


def test_a_load_is_located_by_what_else_is_known() -> None:
    t = np.arange(0.0, 1200.0, STEP)
    gear = np.where((t // 100) % 2 == 0, 9.0, 11.0)
    found = localisation.biased_parts(traces_of(20e3 * (gear == 11.0)), {Quantity.GEAR: gear})
    assert {(p.start, np.sign(p.bias)) for p in found if p.axis == "gear"} == {(11.0, 1.0)}


def test_map_of_the_gap_is_the_mean_residual_of_its_cells() -> None:
    traces = traces_of(20e3, minutes=10.0)
    found = localisation.gap_map(traces, traces.extended)
    i, j = np.unravel_index(int(np.nanargmax(found.samples)), found.samples.shape)
    cell = (traces.speed >= found.speed_edges[i]) & (traces.speed < found.speed_edges[i + 1])
    cell &= traces.acceleration >= found.acceleration_edges[j]
    cell &= traces.acceleration < found.acceleration_edges[j + 1]
    assert found.samples[i, j] == cell.sum()
    assert found.plain[i, j] == pytest.approx((traces.measured - traces.base)[cell].mean())
    assert np.isnan(found.plain[found.samples < localisation.MIN_CELL_ROWS]).all()


# A formula for what has no name


@pytest.mark.slow
def test_a_power_outside_the_catalogue_is_described() -> None:
    t = np.arange(2400.0) + 0.5
    v = driven().fit.strides.speed
    found = best_residual_formula(driven(4.0 * t * v))
    assert found is not None
    assert (found.text, found.unit) == ("v t", "W/m")
    assert abs(found.value - 4.0) < 4 * found.sd
    assert found.log_bayes_factor > 20
    assert 0.8 < found.share < 1.0


def test_noise_is_not_described() -> None:
    assert best_residual_formula(driven()) is None


def test_other_phases_keep_the_spectrum() -> None:
    rng = np.random.default_rng(4)
    for n in (400, 401):
        x = 3.0 + np.cumsum(rng.normal(size=n))
        y = phase_randomised(x, rng)
        assert np.abs(np.fft.rfft(y)) == pytest.approx(np.abs(np.fft.rfft(x)))
        assert y.mean() == pytest.approx(x.mean())
        assert abs(np.corrcoef(np.diff(x), np.diff(y))[0, 1]) < 0.3


def test_rates_of_false_discoveries_are_those_of_scipy() -> None:
    p = np.random.default_rng(1).uniform(size=40) ** 3
    np.testing.assert_allclose(false_discovery_rates(p), false_discovery_control(p))
