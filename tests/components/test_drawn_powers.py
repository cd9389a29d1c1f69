"""Shares and root mean squares by products are those of the arrays of all draws."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from estimator.components.drawn_powers import DrawnPowers

DRAWS = 12


def made(seed: int, count: int, causes: str):
    rng = np.random.default_rng(seed)
    return rng.normal(size=count), {cause: rng.normal(size=(count, DRAWS)) for cause in causes}


def in_batches(residual, powers) -> DrawnPowers:
    batches = [
        DrawnPowers.of(residual, {cause: power[:, at : at + 5] for cause, power in powers.items()})
        for at in range(0, DRAWS, 5)
    ]
    return DrawnPowers.of_draws(batches)


@pytest.fixture
def drives():
    return [made(1, 40, "abc"), made(2, 25, "dca")]


@pytest.fixture
def whole(drives):
    """Arrays of both drives together; a drive has no power of a cause that it lacks."""
    residual = np.concatenate([residual for residual, _ in drives])
    powers = {
        cause: np.concatenate([powers.get(cause, np.zeros((len(residual), DRAWS))) for residual, powers in drives])
        for cause in "abcd"
    }
    return residual, powers


def test_of_several_drives_they_are_those_of_all_values(drives, whole):
    found, (residual, powers) = DrawnPowers.of_drives([in_batches(*drive) for drive in drives]), whole
    assert found.causes == ("a", "b", "c", "d")
    for cause, power in powers.items():
        assert_allclose(found.share(cause), residual @ power / (residual @ residual))
        assert found.rms(cause) == pytest.approx(np.sqrt(np.mean(power**2)))
        assert found.rms_without(cause) == pytest.approx(np.sqrt(np.mean((residual[:, None] - power) ** 2)))
    left = residual[:, None] - powers["a"] - powers["d"]
    assert found.rms_without("a", "d") == pytest.approx(np.sqrt(np.mean(left**2)))


def test_pooled_causes_are_one_whose_power_is_their_sum(drives, whole):
    found = DrawnPowers.of_drives([in_batches(*drive) for drive in drives]).pooled(["b", "d"], "others")
    residual, powers = whole
    both = powers["b"] + powers["d"]
    assert found.causes == ("a", "c", "others")
    assert_allclose(found.share("others"), residual @ both / (residual @ residual))
    assert found.rms("others") == pytest.approx(np.sqrt(np.mean(both**2)))
    assert found.rms_without("others") == pytest.approx(np.sqrt(np.mean((residual[:, None] - both) ** 2)))
    assert_allclose(found.share("c"), residual @ powers["c"] / (residual @ residual))


def test_a_cause_that_is_the_residual_leaves_nothing():
    residual, _ = made(3, 30, "")
    found = DrawnPowers.of(residual, {"all": np.repeat(residual[:, None], DRAWS, axis=1)})
    assert_allclose(found.share("all"), 1.0)
    assert found.rms_without("all") == pytest.approx(0.0, abs=1e-7)
