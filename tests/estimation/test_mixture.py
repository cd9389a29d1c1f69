"""The law of total variance against draws of the mixture."""

import numpy as np
import pytest

from estimator.estimation.mixture import between


@pytest.mark.parametrize("rest", [0.0, 0.3])
def test_moments_of_a_mixture(rest: float) -> None:
    rng = np.random.default_rng(1)
    weights = (1 - rest) * np.array([0.5, 0.2, 0.3])
    shifts = rng.normal(size=(3, 2))
    shift, spread = between(weights, shifts)
    points, p = np.vstack([shifts, np.zeros(2)]), np.append(weights, rest)
    drawn = points[rng.choice(4, size=400_000, p=p)]
    assert shift == pytest.approx(drawn.mean(axis=0), abs=0.01)
    assert spread == pytest.approx(np.cov(drawn.T), abs=0.01)
