"""A Matern process that goes on place by place has the covariance of that process."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.special import gamma, kv

from estimator.model.state_space import passage, rate, stationary

orders = st.sampled_from([1, 2, 4])


def matern(alpha: int, distance: float, length: float) -> float:
    """Correlation of smoothness alpha - 1/2, by the modified Bessel function (Rasmussen & Williams 2006, 4.14)."""
    nu = alpha - 0.5
    x = np.sqrt(2 * nu) * distance / length
    return float(2 ** (1 - nu) / gamma(nu) * x**nu * kv(nu, x))


@given(orders, st.floats(1.0, 2000.0), st.floats(60.0, 3000.0))
def test_places_are_correlated_as_in_a_matern_process(alpha, distance, length):
    forth, _ = passage(alpha, rate(alpha, length) * distance)
    assert (forth @ stationary(alpha))[0, 0] == pytest.approx(matern(alpha, distance, length), abs=1e-9)


@given(orders, st.floats(0.0, 5.0), st.floats(0.0, 5.0))
def test_two_steps_are_one_step_of_their_length(alpha, first, second):
    (F, Q), (G, R), (H, S) = passage(alpha, first), passage(alpha, second), passage(alpha, first + second)
    assert_allclose(G @ F, H, atol=1e-9)
    assert_allclose(G @ Q @ G.T + R, S, atol=1e-9)


@given(orders, st.floats(0.0, 40.0))
def test_noise_has_no_negative_variance(alpha, distance):
    _, noise = passage(alpha, distance)
    assert np.linalg.eigvalsh(noise).min() > -1e-12
