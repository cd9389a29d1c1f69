"""Evidence of a road with slopes on strides whose slopes and noise are known."""

import numpy as np
import pytest
from made_strides import made_strides
from scipy.signal import lfilter

from estimator.estimation.road_evidence import log_bayes_factor_of_road
from estimator.estimation.road_fit import RoadFit, fit
from estimator.signals import Floats
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY

M, A, C = 1600.0, 200.0, 0.35  # a car in a city
SPACING = 5.0  # m


def ornstein_uhlenbeck(n: int, memory: float, rng: np.random.Generator) -> Floats:
    """Of variance 1 at n places, ``memory`` of them long."""
    keep = np.exp(-1 / memory)
    drawn: Floats = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], rng.normal(size=n))
    return drawn


def driven(slope_sd: float, seed: int, n: int = 900) -> Strides:
    """Over slopes of a standard deviation, with noise of the power for 1.2 s, and of force and speed."""
    rng, t = np.random.default_rng(seed), np.arange(n + 1)
    speed = 12 + 5 * np.sin(2 * np.pi * t / 83) + 1.5 * np.sin(2 * np.pi * t / 17)
    v, a = 0.5 * (speed[1:] + speed[:-1]), np.diff(speed)
    places = np.arange(0.0, v.sum() + SPACING, SPACING)
    rough = ornstein_uhlenbeck(len(places), 60.0 / SPACING, rng)
    keep = np.exp(-SPACING / 60.0)
    slope = lfilter([1 - keep], [1.0, -keep], rough)
    slope *= slope_sd / np.std(slope)
    noise = 0.03 * M * 12 / v * ornstein_uhlenbeck(n, 1.2, rng) + M * rng.normal(0, 2e-3, n)
    force = M * a + A + C * v**2 + M * STANDARD_GRAVITY * np.interp(np.cumsum(v), places, slope) + noise
    return made_strides(speed + rng.normal(0, 0.01, n + 1), force, {})


def fits(strides: Strides) -> tuple[RoadFit, RoadFit]:
    """On a level road, and on one with slopes."""
    level, sloping = (fit(strides, level=is_level) for is_level in (True, False))
    assert level is not None
    assert sloping is not None
    return level, sloping


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_a_level_road_does_not_hide_its_slopes(seed: int) -> None:
    """On a level road the noise grows until it holds the slopes, and from there none are found."""
    strides = driven(0.006, seed)
    level, sloping = fits(strides)
    found = log_bayes_factor_of_road(strides, level, [sloping.scales])
    assert found > 15
    assert found == pytest.approx(sloping.log_evidence - level.log_evidence, abs=10)  # but for priors of the scales
    assert found >= log_bayes_factor_of_road(strides, level) - 0.1  # as exact as searches for scales are


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_level_road_has_no_slopes(seed: int) -> None:
    strides = driven(0.0, seed)
    level, sloping = fits(strides)
    assert log_bayes_factor_of_road(strides, level, [sloping.scales]) < 3
