"""The estimators that roadload is compared with find the truth where nothing stands in their way."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.config import Config
from estimator.model.road_load import design
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.units import STANDARD_GRAVITY

TRUTH = np.array([1500.0, 3.5, 22_000.0])  # N, N s^2/m^2, kg
BRAKING = slice(3000, 3050)  # rows
WITHOUT_SLOPES = pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("two_forgetting_factors", ("TwoFactors", (1.0, 0.997, 0.4))),
        ("kalman_with_slope", ("SlopeNoise", (300.0, 0.01, 0.001))),
        ("band_passed", ("Band", (0.03, 0.4))),
    ],
)


def means(found):
    """A, C, m (3,)."""
    return [found[name].mean for name in ("A", "C", "mass")]


@pytest.fixture
def peers():
    return pytest.importorskip("peers.level")


@pytest.fixture
def over_hills():
    return pytest.importorskip("peers.hills")


@pytest.fixture
def rows():
    """Ten minutes without noise; power makes no sense while the brake is on."""
    t = np.arange(6000) * STEP
    v = 14 + 6 * np.sin(2 * np.pi * t / 60) + 3 * np.sin(2 * np.pi * t / 23)
    a = 6 * 2 * np.pi / 60 * np.cos(2 * np.pi * t / 60) + 3 * 2 * np.pi / 23 * np.cos(2 * np.pi * t / 23)
    power = design(v, a) @ TRUTH
    brake = np.zeros(len(t))
    power[BRAKING], brake[BRAKING] = 0.0, 1.0
    return Rows(
        index=np.arange(len(t)),
        speed=v,
        power=power,
        fresh=np.ones((len(t), 2), dtype=bool),
        context={Role.BRAKE_SWITCH: brake},
    )


def test_stretches_leave_out_what_admission_does(peers, rows):
    config = Config().admission
    first, second = peers.stretches(rows, config, 0.0)
    margin = round(config.stride_margin_s / STEP)
    assert len(first.speed) == BRAKING.start - margin
    assert len(second.speed) == len(rows) - BRAKING.stop - margin


def test_recursive_least_squares_finds_the_truth(peers, rows):
    data = peers.stretches(rows, Config().admission, 0.0)
    found = peers.recursive_least_squares(data, peers.Forgetting(mass=0.9999, resistance=0.9999, cutoff=0.4))
    np.testing.assert_allclose(means(found), TRUTH, rtol=0.005)


@pytest.mark.slow
def test_extended_kalman_filter_finds_the_truth(peers, rows):
    data = peers.stretches(rows, Config().admission, 0.0)
    found = peers.extended_kalman(data, peers.ProcessNoise(power=300.0, walk=0.0, speed=0.001))
    np.testing.assert_allclose(means(found), TRUTH, rtol=0.001)


def test_recursion_equals_least_squares_without_forgetting(peers, rows):
    rng = np.random.default_rng(1)
    noisy = Rows(
        index=rows.index,
        speed=rows.speed,
        power=rows.power + rng.normal(0, 5e3, len(rows)),
        fresh=rows.fresh,
        context=rows.context,
    )
    data = peers.stretches(noisy, Config().admission, 0.0)
    found = peers.recursive_least_squares(data, peers.Forgetting(mass=1.0, resistance=1.0, cutoff=0.4))
    parts = [peers.regression(stretch, 0.4) for stretch in data]
    X, force = np.concatenate([x for x, _ in parts]), np.concatenate([f for _, f in parts])
    prior = np.diag((peers.FORCE_NOISE / peers.START_SD) ** 2)
    expected = np.linalg.solve(X.T @ X + prior, X.T @ force + prior @ peers.START)
    np.testing.assert_allclose(means(found), expected, rtol=1e-8)


def uphill(rows):
    """The same drive over slopes of 1 % that pass in 200 s."""
    slope = 0.01 * np.sin(2 * np.pi * rows.t / 200)
    return replace(rows, power=rows.power + TRUTH[2] * STANDARD_GRAVITY * slope * rows.speed)


@pytest.mark.slow
@WITHOUT_SLOPES
def test_those_who_expect_slopes_find_the_mass_over_hills(over_hills, peers, rows, name, settings):
    data = peers.stretches(uphill(rows), Config().admission, 0.0)
    kind, values = settings
    found = getattr(over_hills, name)(data, getattr(over_hills, kind)(*values), over_hills.Known(*TRUTH[:2]))
    assert found.mean == pytest.approx(TRUTH[2], rel=0.03)
    assert found.sd < 0.05 * TRUTH[2]
