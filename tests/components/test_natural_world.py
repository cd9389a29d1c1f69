"""The oracle of drives with hills, wind, cold tyres and auxiliaries: what an effect with a known course is worth."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_strides import made_strides

from estimator.components.drive_state import DriveState
from estimator.components.time_prior import prior_cost
from estimator.model.effects import BY_NAME

NOISE, FORCE, SPAN = 100.0, 60.0, (200.0, 400.0)  # N, N, s
START = 1000.0  # s, of the drive in its log


@pytest.fixture
def tool():
    import check_budget

    return check_budget


def driven(force: Any = np.zeros_like, n: int = 900) -> DriveState:
    """A level drive with white noise of the force, which begins at START, held back by a ``force`` [N] of the time."""
    rng = np.random.default_rng(4)
    speed = 15 + 4 * np.sin(np.arange(n + 1) / 15) + 2 * np.sin(np.arange(n + 1) / 41)
    pull = 20e3 * np.diff(speed) + 2e3 + force(np.arange(n) + 0.5) + rng.normal(0, NOISE, n)
    strides = made_strides(speed, pull, {})
    found = DriveState.of(replace(strides, t=strides.t + START), is_level=True)
    assert found is not None
    return found


def recording(plain: DriveState, force: Any) -> Any:
    """Of a truck that is held back by a ``force`` [N] of the time [s] since the start."""
    t = np.arange(0.0, len(plain.strides), 0.1)
    speed = np.interp(t, plain.strides.t - START, plain.strides.speed)
    truth = SimpleNamespace(t=t, effect_power={"resistance_segment": force(t) * speed}, active={})
    return SimpleNamespace(truth=truth)


def always_on(t: np.ndarray) -> np.ndarray:
    return np.full_like(t, FORCE)


def on(t: np.ndarray) -> np.ndarray:
    return FORCE * ((t >= SPAN[0]) & (t < SPAN[1]))


def test_an_effect_is_worth_what_known_noise_makes_of_it_less_what_noise_of_any_size_can_hold(tool):
    plain = driven(on)
    s = plain.strides
    base = np.column_stack([np.ones(len(s)), s.speed_squared, s.a])
    force, measured = on(s.t - START), s.force[:, 0]
    off = np.linalg.lstsq(base, np.column_stack([force, measured]), rcond=None)[0]
    rest, residual = (np.column_stack([force, measured]) - base @ off).T
    precision, score = 1.0 + rest @ rest / NOISE**2, rest @ residual / NOISE**2
    by_known_noise = 0.5 * score**2 / precision - 0.5 * np.log(precision)
    worth = tool.visibility(recording(plain, on), plain, START, "resistance_segment")
    assert 0.6 * by_known_noise < worth < by_known_noise


def test_times_that_no_signal_shows_take_what_they_cost(tool):
    plain = driven(on)
    told = recording(plain, on)
    worth = tool.visibility(told, plain, START, "resistance_segment")
    told.truth.active["resistance_segment"] = [SPAN]
    spans = ((START + SPAN[0], START + SPAN[1]),)
    cost = prior_cost(spans, BY_NAME["resistance_segment"], plain.fit.strides.t)
    assert worth - tool.visibility(told, plain, START, "resistance_segment") == pytest.approx(cost)


def test_a_force_that_always_acts_cannot_be_told_from_rolling_resistance(tool):
    plain = driven(always_on)
    assert tool.visibility(recording(plain, always_on), plain, START, "resistance_segment") == pytest.approx(
        0.0, abs=0.1
    )
