"""An inertia on the crankshaft: it takes force in proportion to the acceleration, most of it in low gears."""

import numpy as np
import pytest
from made_strides import made_strides

from estimator.estimation.road_fit import fit
from estimator.estimation.road_likelihood import LAG, taken_by
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import BY_NAME
from estimator.signals import Quantity

MASS, A, C, J = 16_000.0, 900.0, 3.5, 4.0
TERM = EffectTerm(BY_NAME["rotating_inertia"])


def urban(n: int = 1500):
    """Strides of a drive on a level road through five gears, where the crankshaft has an inertia of J."""
    rng = np.random.default_rng(5)
    speed = 9 + 6 * np.sin(2 * np.pi * np.arange(n + 1) / 80) + np.sin(2 * np.pi * np.arange(n + 1) / 23)
    v, a = 0.5 * (speed[1:] + speed[:-1]), np.diff(speed)
    gearing = np.array([44.0, 28.0, 18.0, 12.0, 8.0])[np.digitize(v, [4.0, 7.0, 10.0, 13.0])]  # rad/m
    force = (MASS + J * gearing**2) * a + A + C * v**2 + rng.normal(0.0, 100.0, n)
    return made_strides(speed, force, {Quantity.ENGINE_SPEED: gearing * v}), gearing


def test_an_inertia_takes_its_share_of_the_force_that_accelerates():
    strides, gearing = urban()
    force = strides.force[:, 0]
    taken = taken_by(strides, force, np.array([A, C, MASS]), [TERM], np.array([J]))
    inertia = J * gearing**2
    accelerates = force - A - C * strides.relative_density * strides.speed_squared
    assert taken == pytest.approx(inertia / (MASS + inertia) * accelerates)


def test_mass_and_inertia_are_told_apart_in_low_gears():
    """Where the inertia is half the mass, a column of the acceleration without it would find three quarters of it."""
    found = fit(urban()[0], [TERM], level=True)
    sd = np.sqrt(np.diag(found.theta_covariance()))
    assert found.theta[LAG + 1] == pytest.approx(J, rel=0.03)
    assert found.theta[LAG + 1] == pytest.approx(J, abs=2.5 * sd[LAG + 1])
    assert found.theta[2] == pytest.approx(MASS, rel=0.01)
