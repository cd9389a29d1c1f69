"""Lone wrong speeds: dropped where no vehicle can have had them, and nothing else is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.settings import Vehicle
from estimator.signals import Role, Series
from estimator.streaming.alignment import Aligner
from estimator.streaming.lone_errors import MAX_ACCELERATION, MIN_ERROR, lone_errors

PERIOD = 0.1  # s, of CCVS1
QUANTUM = 1 / 256 / 3.6  # m/s


def drive(rng: np.random.Generator, n: int, acceleration: float = 3.0, noise: float = 0.05) -> np.ndarray:
    """A speed [m/s] (n,) that changes by at most ``acceleration`` [m/s^2], with noise and resolution."""
    slope = np.clip(np.cumsum(rng.normal(0, 0.3, n)), -acceleration, acceleration)
    speed = np.abs(20.0 + np.cumsum(slope) * PERIOD) + rng.normal(0, noise, n)
    return np.round(speed / QUANTUM) * QUANTUM


@given(st.integers(0, 1000), st.floats(0.0, 8.0), st.floats(0.0, 0.1))
def test_honest_readings_stay(seed: int, acceleration: float, noise: float) -> None:
    rng = np.random.default_rng(seed)
    t = PERIOD * np.arange(300) + rng.uniform(0, 0.04, 300)
    assert not lone_errors(t, drive(rng, 300, acceleration, noise)).any()


@pytest.mark.slow
@given(
    st.lists(st.floats(-MAX_ACCELERATION, MAX_ACCELERATION), min_size=3, max_size=50),
    st.lists(st.floats(0.001, 1.0), min_size=50, max_size=50),
)
def test_whatever_tyres_can_do_stays(slopes: list[float], periods: list[float]) -> None:
    t = np.concatenate([[0.0], np.cumsum(periods[: len(slopes)])])
    speed = np.concatenate([[50.0], 50.0 + np.cumsum(np.array(slopes) * np.diff(t))])
    assert not lone_errors(t, speed).any()


@given(st.integers(0, 1000), st.sampled_from([0.0, 0.7, 1.1, 1.3, 3.0]), st.floats(0.001, 0.09))
def test_a_forged_reading_among_honest_ones_goes_and_no_other(seed: int, factor: float, after: float) -> None:
    rng = np.random.default_rng(seed)
    t, speed = PERIOD * np.arange(100), np.maximum(drive(rng, 100), 18.0)
    place = int(rng.integers(2, 97))
    forged_t = np.insert(t, place + 1, t[place] + after)
    forged = np.insert(speed, place + 1, factor * speed[place])
    wrong = lone_errors(forged_t, forged)
    expected = abs(1 - factor) * speed[place] > MIN_ERROR + MAX_ACCELERATION * PERIOD / 2 + 0.6
    assert wrong[place + 1] or not expected
    assert not np.delete(wrong, place + 1).any()


def test_a_step_that_lasts_and_readings_that_are_not_valid_stay() -> None:
    t = PERIOD * np.arange(6)
    assert not lone_errors(t, np.array([20.0, 20.0, 26.0, 26.0, 26.0, 26.0])).any()
    assert not lone_errors(t, np.array([20.0, np.nan, 26.0, np.nan, 20.0, 20.0])).any()
    assert not lone_errors(t[:2], np.array([20.0, 0.0])).any()


@pytest.mark.parametrize("role", [Role.SPEED, Role.WHEEL_SPEEDS])
def test_rows_are_those_of_the_drive_without_the_errors_which_are_counted(role: Role) -> None:
    t = PERIOD * np.arange(200)
    speed = drive(np.random.default_rng(1), 200)
    forged_t = np.insert(t, np.arange(10, 200, 40) + 1, t[10::40] + 0.002)
    forged = np.insert(speed, np.arange(10, 200, 40) + 1, 1.3 * speed[10::40])

    def rows(despike: bool, t: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, Aligner]:
        aligner = Aligner(Vehicle(), frozenset({role}), despike)
        parts = [part for end in (5.0, 10.0, 15.0, 20.0) for part in fed(aligner, t, speed, end)]
        return np.concatenate(parts), aligner

    def fed(aligner: Aligner, t: np.ndarray, speed: np.ndarray, end: float) -> list[np.ndarray]:
        now = (t >= end - 5.0) & (t < end)
        return [part.speed for part in aligner.feed({role: [Series(t[now], speed[now])]}, end)]

    clean, aligner = rows(True, t, speed)
    assert not aligner.refused
    mended, aligner = rows(True, forged_t, forged)
    np.testing.assert_allclose(mended, clean, atol=1e-9)
    assert aligner.refused == {f"{role.value}: contradicted by the readings before and after": 5}
    harmed, aligner = rows(False, forged_t, forged)
    assert not aligner.refused
    assert np.nanmax(np.abs(harmed - clean)) > 1.0
