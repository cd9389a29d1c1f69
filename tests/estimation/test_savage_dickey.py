"""The log Bayes factor of one more amplitude, held against the evidence of the whole Gaussian model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from estimator.estimation.savage_dickey import log_bayes_factor, posterior_of


@given(seed=st.integers(0, 2**16), prior_sd=st.floats(0.05, 20.0))
def test_the_ratio_is_that_of_the_evidence_with_the_column_and_without_it(seed: int, prior_sd: float) -> None:
    rng = np.random.default_rng(seed)
    column, noise = rng.normal(size=12), 0.3 + np.abs(rng.normal(size=12))
    observed = rng.normal() * column + noise * rng.normal(size=12)
    strength, score = float(column**2 @ noise**-2), float(column * observed @ noise**-2)
    value, sd = posterior_of(score, strength, prior_sd)
    without = np.diag(noise**2)
    beside = without + prior_sd**2 * np.outer(column, column)
    brute = multivariate_normal(cov=beside).logpdf(observed) - multivariate_normal(cov=without).logpdf(observed)
    assert log_bayes_factor(value, sd, prior_sd) == pytest.approx(brute, abs=1e-8)


def test_a_strength_that_rounding_made_negative_leaves_the_prior() -> None:
    value, sd = posterior_of(0.0, -1e-12, prior_sd=2.0)
    assert (value, sd) == (0.0, 2.0)
    assert log_bayes_factor(value, sd, 2.0) == 0.0
