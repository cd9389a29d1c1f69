"""What the parts of a drive say of the mass: a change of the force widens the estimate or withholds it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from made_strides import made_strides
from numpy.testing import assert_allclose

from estimator.estimation.gain_changes import (
    BESIDE_SDS,
    CHANGES,
    MAX_EXPECTED,
    GainChanges,
    gain_changes,
)
from estimator.estimation.road_fit import fit, fit_given
from estimator.estimation.road_likelihood import PARTS, Likelihood, earlier_loads, shapes_of
from estimator.model.conditioned import Conditioned

M, A, C = 25e3, 1600.0, 3.5
NOISE = 4e-3  # m/s^2


def driven(n=900, gain=None, masses=None, seed=5):
    """A drive whose torque reads ``gain`` (n,) times what it is, with a mass for each stride."""
    rng = np.random.default_rng(seed)
    speed = 15 + 5 * np.sin(2 * np.pi * np.arange(n + 1) / 90) + 2 * np.sin(2 * np.pi * np.arange(n + 1) / 37)
    v, mass = 0.5 * (speed[1:] + speed[:-1]), np.full(n, M) if masses is None else masses
    force = mass * (np.diff(speed) + A / M) + C * v**2 + M * rng.normal(0, NOISE, n)
    return made_strides(speed, force * (np.ones(n) if gain is None else gain), {})


@pytest.fixture(scope="module")
def scales():
    """Those of a drive that does not change, as they are found before a change."""
    return fitted(driven()).scales


def fitted(strides, scales=None, departures=()):
    found = fit_given(strides, scales, departures=departures) if scales else fit(strides)
    assert found is not None
    return found


def ramp(n, change):
    return 1 + change * (np.arange(n) + 0.5) / n


def step(n, change, part):
    return np.where(np.arange(n) >= n * part // PARTS, 1 + change, 1.0)


def test_probabilities_and_coefficients_are_those_of_one_gaussian_a_shape():
    """Each shape by itself, its columns and its prior written out."""
    strides = driven(160, gain=ramp(160, 0.02))
    found = fitted(strides)
    equations = found.equations
    nothing = {name: 0 * getattr(equations, name) for name in ("noise", "driver_bias", "moved")}
    found = replace(found, equations=replace(equations, **nothing))
    model = found.scales.model_of(strides)
    likelihood = Likelihood(model, (), found.road_load, found.scales.lag)
    n, p, unit = len(strides), len(likelihood.prior), likelihood.unit
    precision = Conditioned.of(model, found.scales.values).gram(np.eye(n))
    y, X = likelihood.data[:, 0], likelihood.data[:, 1:]
    m = found.road_load[2]
    whole = [found.beta[0], found.road_load[0] / m, found.road_load[1] / m] * unit[:3]
    beside = (BESIDE_SDS * whole[1:]) ** -2

    def solved(design, prior):
        """Coefficients, and log likelihood without what all designs share."""
        information = design.T @ precision @ design + np.diag(prior)
        beta = np.linalg.solve(information, design.T @ precision @ y)
        volume = np.linalg.slogdet(information)[1] - np.log(prior).sum()
        return beta, 0.5 * (y @ precision @ design @ beta - volume)

    known, logs, shifts = np.diag(likelihood.prior), [], []
    for g in shapes_of(np.ones(n, dtype=bool)).T:
        others = np.column_stack([X, X[:, 1:3] * g[:, None]])
        _, without = solved(others, np.append(known, beside))
        for sd, _ in CHANGES:
            prior = np.concatenate([known, beside, [(sd * whole[0]) ** -2]])
            beta, log = solved(np.column_stack([others, X[:, 0] * g]), prior)
            logs.append(log - without)
            shifts.append((beta[:p] - solved(X, known)[0]) / unit)
    chances = np.array([rate for _, rate in CHANGES]) * n
    assert chances.sum() < MAX_EXPECTED
    odds = np.exp([0.0, *logs]) * np.array([1 - chances.sum(), *(list(chances / PARTS) * PARTS)])
    changes = gain_changes(found)
    assert_allclose(changes.probability, odds[1:] / odds.sum(), rtol=1e-5)
    assert_allclose(changes.shift, shifts, rtol=1e-3, atol=1e-9)


def test_the_average_has_the_variance_of_its_parts_and_half_the_change():
    found = fitted(driven(200))
    rng, p = np.random.default_rng(3), len(found.beta)
    shift, root = rng.normal(size=(2, p)) * found.beta, rng.normal(size=(2, p, p)) * found.beta[:, None]
    spread = root @ root.transpose(0, 2, 1)
    changes = GainChanges(
        probability=np.array([0.3, 0.2]),
        shift=shift,
        covariance=spread,
        size=np.array([0.1, -0.2]),
        sd=np.array([0.05, 0.1]),
    )
    weight = np.array([0.5, 0.3, 0.2])
    each = np.array([found.beta, *(found.beta + shift)])
    mean = weight @ each
    covariance = sum(
        w * (found.covariance + more + np.outer(b - mean, b - mean))
        for w, b, more in zip(weight, each, [np.zeros((p, p)), *spread], strict=True)
    )
    covariance[0, 0] += found.beta[0] ** 2 * (0.3 * (0.1**2 + 0.05**2) + 0.2 * (0.2**2 + 0.1**2)) / 4
    averaged = changes.averaged(found)
    assert_allclose(averaged.beta, mean)
    assert_allclose(averaged.covariance, covariance)


@pytest.mark.slow
def test_a_drive_that_does_not_change_keeps_its_interval():
    widened = []
    for seed in range(8):
        strides = driven(seed=seed)
        found = fitted(strides)
        changes = gain_changes(found)
        assert changes.contradiction(found) == ""
        widened.append(np.sqrt(changes.averaged(found).covariance[0, 0] / found.covariance[0, 0]))
    assert np.median(widened) < 1.1


@pytest.mark.parametrize(
    ("gain", "size"), [(ramp(900, 0.3), 0.25), (step(900, 0.2, 2), 0.18), (step(900, -0.15, 3), -0.16)]
)
def test_a_large_change_of_the_torque_is_a_contradiction(scales, gain, size):
    strides = driven(gain=gain)
    found = fitted(strides, scales)
    changes = gain_changes(found)
    assert changes.probability.sum() > 0.999
    assert changes.size[np.argmax(changes.probability)] == pytest.approx(-size, rel=0.15)
    contradiction = changes.contradiction(found)
    assert re.fullmatch(r"two parts .* each other: mass \d{1,2},\d{3} and \d{1,2},\d{3} kg", contradiction)


def test_the_masses_of_a_contradiction_are_those_before_and_after(scales):
    strides = driven(masses=np.where(np.arange(900) < 450, M, 1.2 * M))
    found = fitted(strides, scales)
    reason = gain_changes(found).contradiction(found)
    before, after = (float(word.replace(",", "")) for word in re.findall(r"\d+,\d{3}", reason))
    assert before == pytest.approx(M, rel=0.02)
    assert after == pytest.approx(1.2 * M, rel=0.02)


def test_a_part_without_a_mass_is_said_to_have_none(scales):
    """A torque that reads the opposite of what it is in the second half."""
    found = fitted(driven(gain=step(900, -1.5, PARTS // 2)), scales)
    reason = gain_changes(found).contradiction(found)
    assert reason == "two parts of the drive contradict each other: in one of them speed does not change with force"


def test_a_small_drift_widens_the_mass_by_half_of_what_it_changes(scales):
    strides = driven(gain=ramp(900, 0.03))
    found = fitted(strides, scales)
    changes = gain_changes(found)
    averaged = changes.averaged(found)
    assert changes.contradiction(found) == ""
    assert np.sqrt(averaged.covariance[0, 0]) / averaged.beta[0] == pytest.approx(0.015, rel=0.35)


def test_a_change_of_tyres_or_wind_is_no_change_of_the_mass(scales):
    n = 900
    drag = 0.3 * A * (np.arange(n) > n // 2)
    strides = driven()
    changed = made_strides(np.append(strides.v0, strides.v1[-1]), strides.force[:, 0] + drag, {})
    found = fitted(changed, scales)
    assert gain_changes(found).contradiction(found) == ""


def test_only_the_present_load_is_asked(scales):
    masses = np.where(np.arange(900) < 450, M, 1.2 * M)
    strides = driven(masses=masses)
    found = fitted(strides, scales, departures=(450.0,))
    assert earlier_loads(strides.t, (450.0,)).sum() == 450
    changes = gain_changes(found)
    assert changes.contradiction(found) == ""
    assert changes.probability.sum() < 0.2
