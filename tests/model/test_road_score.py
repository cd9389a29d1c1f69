"""How the evidence changes with the scales, against differences of the evidence and dense matrices."""

import numpy as np
import pytest
from dense_road import ORDERS, SHOWN, Dense, likelihood_of, observed, scales_of, strides_of
from numpy.testing import assert_allclose

from estimator.model.road_score import average_information, changed_by_scales

STEP = 1e-4  # of the logarithm of a scale


def at(scales, i, step):
    return scales * np.exp(step * (np.arange(len(scales)) == i))


def change(of, scales, i):
    """Derivative of a function of the scales by the logarithm of one."""
    return (of(at(scales, i, STEP)) - of(at(scales, i, -STEP))) / (2 * STEP)


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(("alpha", "wander"), ORDERS)
def test_the_gradient_is_that_of_the_log_evidence(shown, alpha, wander):
    likelihood = likelihood_of(strides_of(shown=shown), alpha, wander)
    for seed in (3, 4):
        scales = scales_of(likelihood.model, seed)
        expected = np.array([change(likelihood.log_evidence, scales, i) for i in range(len(scales))])
        assert_allclose(likelihood.score(scales).gradient, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
def test_the_information_is_the_average_of_the_observed_and_the_expected_one(shown):
    likelihood = likelihood_of(strides_of(shown=shown))
    model, keep = likelihood.model, observed(likelihood.model)
    data, scales = likelihood.data[keep], scales_of(likelihood.model, 5)
    V = Dense(model, scales).K + data[:, 1:] @ np.linalg.inv(likelihood.prior) @ data[:, 1:].T
    weighed = np.linalg.solve(V, data[:, 0])
    turned = [change(lambda s: Dense(model, s).K, scales, i) @ weighed for i in range(len(scales))]
    answers = np.column_stack(turned)
    expected = 0.5 * answers.T @ np.linalg.solve(V, answers)
    found = likelihood.score(scales).information
    assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    assert np.all(np.linalg.eigvalsh(found) > -1e-9 * np.abs(found).max())


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
def test_the_information_without_the_gradient_is_the_same(shown):
    likelihood = likelihood_of(strides_of(shown=shown))
    scales = scales_of(likelihood.model, 5)
    conditioned, gram = likelihood.at(scales)
    beta, precision, _ = likelihood.solve(gram)
    X = likelihood.data[:, 1:]
    changed = changed_by_scales(conditioned, scales, likelihood.data[:, 0] - X @ beta)
    products = conditioned.gram(np.column_stack([X, changed]))
    p = X.shape[1]
    found = average_information(products[p:, p:], products[:p, p:], precision)
    expected = likelihood.score(scales).information
    assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_on_data_drawn_from_the_model_the_mean_score_is_zero_and_its_variance_the_information():
    likelihood = likelihood_of(strides_of(60, unknown=(), silence=60))
    model, scales = likelihood.model, scales_of(likelihood.model, 6)
    V = Dense(model, scales).K + likelihood.data[:, 1:] @ np.linalg.inv(likelihood.prior) @ likelihood.data[:, 1:].T
    root, rng = np.linalg.cholesky(V), np.random.default_rng(7)
    gradients, information = [], []
    for _ in range(400):
        likelihood.data[:, 0] = root @ rng.normal(size=len(V))
        likelihood._last = None  # of other data
        found = likelihood.score(scales)
        gradients.append(found.gradient)
        information.append(found.information)
    variance = np.cov(np.array(gradients).T)
    sd = np.sqrt(np.diag(variance))
    assert np.all(np.abs(np.mean(gradients, axis=0)) < 4 * sd / 20)
    assert np.sqrt(np.diag(np.mean(information, axis=0))) == pytest.approx(sd, rel=0.2)
