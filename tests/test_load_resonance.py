"""A load that swings on its springs: told from a load that does not, and from a speed that is filtered."""

import numpy as np
import pytest
from scipy.signal import lfilter
from simulated_logs import ask, drive, written

from estimator.config import Config
from estimator.diagnosis.averaged_residual import averages_of
from estimator.diagnosis.drive_data import record
from estimator.diagnosis.load_resonance import swing
from estimator.diagnosis.model import fit, select
from estimator.diagnosis.processes import Leftover
from estimator.diagnosis.thresholds import Thresholds
from estimator.samples import STEP, Rows
from estimator.simulation.effects.effect import Effect

pytestmark = pytest.mark.slow

A, C, MASS = 1739.0, 3.74, 27_190.0
LOAD = 0.2 * MASS  # kg
FINE = 10  # steps of the world for each of the grid
MINUTES = 30


def travelled(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Speed [m/s] and acceleration [m/s^2] in fine steps: a pedal that is moved every few seconds."""
    n, dt = round(60 * MINUTES / STEP), STEP / FINE
    pedal = np.repeat(rng.normal(0, 0.4, n * FINE // 300 + 1), 300)[: n * FINE]
    a = lfilter([dt / 0.4], [1, dt / 0.4 - 1], pedal)
    v = np.empty(len(a))
    now = 15.0
    for i in range(len(a)):
        a[i] += 0.02 * (15.0 - now)  # the driver holds the speed
        now += a[i] * dt
        v[i] = now
    return v, a


def swinging(a: np.ndarray, period: float, damping: float) -> np.ndarray:
    """Acceleration [m/s^2] of a load on a spring over that of the vehicle."""
    w, dt = 2 * np.pi / period, STEP / FINE
    x = u = 0.0
    over = np.empty(len(a))
    for i, now in enumerate(a):
        over[i] = -now - 2 * damping * w * u - w * w * x
        u += over[i] * dt
        x += u * dt
    return over


def evidence(rng: np.random.Generator, load: float, period: float = 2.6, lowpass: float = 0.0) -> Leftover:
    """What is said of a drive with ``load`` [kg] on a spring, its speed read through a low-pass [s]."""
    v, a = travelled(rng)
    power = v * (A + C * v**2 + MASS * a + load * swinging(a, period, 0.08))
    share = 1.0 if lowpass == 0 else STEP / FINE / lowpass
    read = lfilter([share], [1, share - 1], v - v[0]) + v[0]
    speed = read[::FINE] + rng.normal(0, 0.005, len(v) // FINE)
    measured = power[::FINE] + rng.normal(0, 3e3, len(speed))
    n = len(speed)
    drove = record(
        [Rows(index=np.arange(n), speed=speed, power=measured, fresh=np.ones((n, 2), dtype=bool), context={})], Config()
    )
    kept = select(drove.samples)
    assert kept is not None
    model = fit(drove.samples[kept])
    assert model is not None
    return swing(drove, model, averages_of(model))


@pytest.mark.parametrize("period", [2.0, 2.6, 4.0])
def test_a_load_that_swings_is_seen_with_its_period(period):
    found = evidence(np.random.default_rng(4), LOAD, period)
    assert found.log_bayes_factor > 30
    assert float(found.name.removesuffix(" s").rpartition(" ")[2]) == pytest.approx(period, rel=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_a_load_that_is_fixed_does_not_swing(seed):
    assert evidence(np.random.default_rng(seed), 0.0).log_bayes_factor < 0


@pytest.mark.parametrize("lowpass", [0.2, 0.5])
def test_a_filtered_speed_does_not_swing(lowpass):
    assert evidence(np.random.default_rng(1), 0.0, lowpass=lowpass).log_bayes_factor < Thresholds().max_log_bf_no_gap


def test_a_sloshing_tank_is_an_unknown_effect(tmp_path):
    recording = drive("mixed", 25, 2, Effect(name="liquid_surge", magnitude=0.3), speed_noise=0.008)
    answer = ask("diagnose", written(recording, tmp_path / "tank.blf"))
    assert (answer["verdict"], answer["effects"]) == ("unknown effect", [])
    assert "rings on after accelerations" in answer["reason"]
    assert answer["remaining"]["verdict"] == "unknown effect"
