"""Experiments that would tell effects apart: the evidence to expect, against fits to drives without noise."""

from dataclasses import replace

import numpy as np
import pytest
from driven_on_hills import A, C, M, driven
from numpy.testing import assert_allclose

from estimator.components.drive_state import DriveState, FittedTerm
from estimator.components.term import Frame, untimed_terms
from estimator.diagnosis import experiment
from estimator.diagnosis.experiment import Manoeuvre, expected_log_bf, experiments, manoeuvres
from estimator.model.effects import BY_NAME
from estimator.model.effects.effect import AtRest
from estimator.preparation.recursion import low_passed
from estimator.roles import PAST_SPEEDS
from estimator.signals import Quantity
from estimator.strides import LAGS, Strides


@pytest.fixture(scope="module")
def state() -> DriveState:
    """A level drive."""
    hilly = driven()
    noise = np.random.default_rng(5).normal(0, 6e-3, len(hilly))
    force = M * hilly.a + A + C * hilly.speed**2 + M * noise
    found = DriveState.of(replace(hilly, force=np.repeat(force[:, None], len(LAGS), axis=1)))
    assert found is not None
    return found


def form_of(state: DriveState, name: str, value: float) -> FittedTerm:
    term = untimed_terms(Frame.of(state.fit), BY_NAME[name], frozenset(state.strides.context))[0]
    column = term.columns(Frame.of(state.fit))[:, 0]
    return FittedTerm(term=term, gain=0.0, value=value, sd=1.0, trace=column)


def test_evidence_to_expect_is_that_of_the_drive_on_which_the_effect_acts(state: DriveState) -> None:
    """Residual power is what the effect takes; the difference of the two fits is the log Bayes factor to expect."""
    acting, other = form_of(state, "auxiliary_load", 2e4), form_of(state, "viscous_drag", 0.5)
    joint = state.joint_with([other.term])
    column = acting.term.columns(joint.frame)
    rival = joint.columns[:, joint.term_columns[0]].toarray()[: len(column)]
    products, _ = joint.projected([], np.column_stack([acting.value * column, rival]))
    precision = products[1, 1] + other.term.sd**-2.0
    left = products[0, 0] - products[0, 1] ** 2 / precision  # of the squared residual, beside the other effect
    assert expected_log_bf(state, acting, other, None) == pytest.approx(0.5 * left, rel=1e-6)


def test_against_nothing_the_width_of_the_prior_counts(state: DriveState) -> None:
    """The mean of the log Bayes factor of a Gaussian magnitude over data of that magnitude, less its noise."""
    acting = form_of(state, "auxiliary_load", 2e4)
    joint = state.joint
    strength = joint.projected([], acting.term.columns(joint.frame))[0][0, 0]
    wanted = 0.5 * (acting.value**2 * strength - np.log1p(strength * acting.term.sd**2))
    assert expected_log_bf(state, acting, None, None) == pytest.approx(wanted)


def test_a_manoeuvre_is_driven_by_the_road_load(state: DriveState) -> None:
    held, rising = np.full(61, 20.0), np.arange(2.0, 12.0, 0.5)
    parts = Manoeuvre(name="two", parts=(held, rising), lowered=(1,), from_rest=True)
    after = experiment.driven(state, parts)
    theta = state.fit.theta
    assert len(after) == 60 + 19
    assert after.t[0] == pytest.approx(state.strides.t[-1] + 10.5)
    assert np.all(np.diff(after.t) > 0)
    assert_allclose(after.s0[1:], after.s1[:-1])
    assert list(np.flatnonzero(~after.joined)) == [0, 60]
    v, a = after.speed, after.a
    assert_allclose(after.force[:, 0], theta[0] + theta[1] * v**2 + theta[2] * a)
    assert_allclose(after.context[Quantity.ENGINE_SPEED][:60], 8.0 * v[:60])  # as everywhere in the drive
    assert_allclose(after.context[Quantity.ENGINE_SPEED][60:], 1.35 * 8.0 * v[60:])
    assert list(after.context[Quantity.STOPS][[0, -1]]) == [1, 2]
    for quantity, time in PAST_SPEEDS.items():  # the parts follow the drive and each other
        before = state.strides.context[quantity][-1]
        assert_allclose(after.context[quantity], low_passed(v, before, 1.0, time))
    assert parts.minutes == pytest.approx((10 + 61 + 20 + 2 * 10) / 60, abs=0.05)
    assert theta[:3] == pytest.approx([A, C, M], rel=0.5)


def test_a_manoeuvre_adds_evidence(state: DriveState) -> None:
    acting, other = form_of(state, "auxiliary_load", 2e4), form_of(state, "viscous_drag", 0.5)
    now = expected_log_bf(state, acting, other, None)
    gains = {m.name: expected_log_bf(state, acting, other, m) - now for m in manoeuvres(state)}
    assert all(gain > -1e-6 for gain in gains.values())
    assert max(gains.values()) > 5 * max(now, 0.1)
    assert not any("way back" in name for name in gains)  # the heading is not known


def test_the_way_back_is_considered_where_the_heading_is_known(state: DriveState) -> None:
    context = {**state.strides.context, Quantity.HEADING: np.full(len(state.strides), 0.5)}
    strides: Strides = replace(state.strides, context=context)
    turned = replace(state, strides=strides, fit=replace(state.fit, strides=strides[strides.known]))
    back = next(m for m in manoeuvres(turned) if "way back" in m.name)
    assert_allclose(experiment.driven(turned, back).context[Quantity.HEADING], 0.5 + np.pi)


EVIDENCE = {"auxiliary_load": 6.0, "rotating_inertia": 4.0}


def test_idling_tells_a_load_of_the_engine_where_it_is_not_known(state: DriveState) -> None:
    acting, other = form_of(state, "auxiliary_load", 1.5e4), form_of(state, "rotating_inertia", 3.0)
    (idling,) = [
        choice for choice in experiment.possible_experiments(state, acting, other, EVIDENCE) if "idling" in choice.what
    ]
    assert idling.now == 2.0
    assert idling.expected - 2.0 == pytest.approx(0.5 * (1.5e4 / (800 + 0.15 * 1.5e4)) ** 2)  # inertia takes none there
    known = replace(state, rests=(AtRest(power=1.5e4, sd=1e3, engine_speed=63.0),))
    assert not any(
        "idling" in choice.what for choice in experiment.possible_experiments(known, acting, other, EVIDENCE)
    )


@pytest.mark.slow
def test_a_manoeuvre_counts_as_far_as_the_search_has_found_the_same_evidence(state: DriveState) -> None:
    other = form_of(state, "rotating_inertia", 3.0)
    gains = []
    for gain in (6.0, 12.0, 3.0, -1.0):
        acting = replace(form_of(state, "auxiliary_load", 1.5e4), gain=gain)
        gains.append(experiment.possible_experiments(state, acting, other, EVIDENCE)[0].expected - 2.0)
    assert gains[0] > 0
    assert gains == pytest.approx([gains[0], 0.5 * gains[0], gains[0], 0.0])


def test_a_pair_that_the_drive_cannot_judge_is_left_out(state: DriveState) -> None:
    assert experiments(state, [(BY_NAME["cornering"], BY_NAME["auxiliary_load"])], EVIDENCE) == ()


def test_a_drive_that_is_never_slow_has_manoeuvres_but_no_starts(state: DriveState) -> None:
    strides = state.fit.strides
    fast = replace(strides, v0=strides.v0 + 30.0, v1=strides.v1 + 30.0)
    names = [m.name for m in experiment.manoeuvres(replace(state, fit=replace(state.fit, strides=fast)))]
    assert any("minutes each at" in name for name in names)
    assert not any("starts from rest" in name for name in names)
    assert any("starts from rest" in m.name for m in experiment.manoeuvres(state))
