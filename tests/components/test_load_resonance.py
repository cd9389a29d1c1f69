"""A load that swings on its springs: its motion against small steps of time, and a drive with a tank of liquid."""

from dataclasses import replace

import numpy as np
import pytest
from driven_on_level_road import driven
from simulated_logs import ask, drive, written

from estimator.components.processes import RING, processes, ringing
from estimator.components.term import Frame
from estimator.simulation.effects.effect import Effect

FINE = 1000  # steps of a second


def stepped(a: np.ndarray, period: float, ratio: float) -> np.ndarray:
    """Mean of x'' over each second, for an acceleration ``a`` (n,) that is constant during it."""
    w, dt = 2 * np.pi / period, 1 / FINE
    x = u = 0.0
    mean = np.zeros(len(a))
    for k, now in enumerate(a):
        for _ in range(FINE):
            over = -now - 2 * ratio * w * u - w * w * x
            mean[k] += over * dt
            u += over * dt
            x += u * dt
    return mean


@pytest.mark.slow
@pytest.mark.parametrize(("period", "ratio"), [(1.5, 0.05), (2.6, 0.1), (5.8, 0.15)])
def test_the_ringing_of_a_mass_is_that_of_its_equation_of_motion(period, ratio):
    frame = Frame.of(driven(minutes=3.0).fit)
    exact = stepped(frame.view.a, period, ratio)
    assert ringing(frame, period, ratio) == pytest.approx(exact, abs=0.02 * np.abs(exact).max())


def test_a_mass_is_at_rest_after_a_gap():
    frame = Frame.of(driven(minutes=3.0).fit)
    second = frame.strides[90:]
    later = replace(second, t=second.t + 60.0)
    whole = replace(frame, strides=type(later).concatenate([frame.strides[:90], later]), force=frame.force)
    apart = replace(frame, strides=later, force=frame.force[90:], effect_force=frame.effect_force[90:])
    assert ringing(whole, 2.0, 0.1)[90:] == pytest.approx(ringing(apart, 2.0, 0.1), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("period", [2.0, 2.6, 4.0])
def test_a_load_that_swings_is_seen_with_its_period(period):
    plain = driven(minutes=30.0)
    frame = Frame.of(plain.fit)
    rng = np.random.default_rng(1)
    jolts = np.repeat(rng.normal(0, 0.3, len(frame.strides) // 3 + 1), 3)[: len(frame.strides)]
    strides = replace(plain.strides, a=plain.strides.a + jolts, v1=plain.strides.v1)
    force = plain.strides.force + 27_190.0 * jolts[:, None]
    moved = replace(strides, force=force)
    own = replace(frame, strides=moved, force=force[:, 0])
    held = 0.1 * 27_190.0 * ringing(own, period, 0.1)
    state = type(plain).of(replace(moved, force=force + held[:, None]), is_level=True)
    assert state is not None
    rings = [c for c in processes(Frame.of(state.fit)) if c.name == RING]
    joint = state.joint_with(rings)
    gains = [joint.log_evidence([i]) - joint.log_evidence([]) for i in range(len(rings))]
    best = int(np.argmax(gains))
    assert gains[best] > 30
    tried = 1.5 * 1.13 ** (best // 2)
    assert tried == pytest.approx(period, rel=0.15)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_sloshing_tank_is_an_unknown_effect(tmp_path):
    recording = drive("mixed", 25, 3, Effect(name="liquid_surge", magnitude=0.3), speed_noise=0.008)
    answer = ask("diagnose", written(recording, tmp_path / "tank.blf"))
    assert (answer["verdict"], answer["effects"]) == ("unknown effect", [])
    assert "rings on after accelerations" in answer["reason"]
