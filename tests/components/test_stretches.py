"""Steep stretches of a hidden road are the road's, and a load that switches is none of them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_strides import made_strides, past_speeds
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter1d

from estimator.components.budget import ROAD, budget
from estimator.components.drive_state import DriveState
from estimator.components.search import Search
from estimator.components.stretches import STRETCHES, stretches
from estimator.components.term import Frame, Kind
from estimator.components.time_prior import CHANGE_COST
from estimator.estimation.road_evidence import log_bayes_factor_of_road
from estimator.model.effects import BY_NAME
from estimator.model.spans import covered, cut, union
from estimator.signals import Quantity
from estimator.units import STANDARD_GRAVITY

M, A, C = 25e3, 1600.0, 3.5
EFFECTS = [BY_NAME[name] for name in ("auxiliary_cycling", "brake_use", "resistance_segment", "auxiliary_load")]
STEEP = ((300.0, 380.0, 0.030), (700.0, 770.0, 0.022), (1100.0, 1190.0, 0.036))  # s, s, sine
spans = st.lists(st.integers(0, 60), min_size=2, max_size=8, unique=True).map(
    lambda edges: tuple((float(a), float(b)) for a, b in zip(sorted(edges)[::2], sorted(edges)[1::2], strict=False))
)


def smooth(rng, n, width):
    """White noise (n,) under a Gaussian ``width`` samples wide, of sd 1."""
    noise = gaussian_filter1d(rng.normal(size=n), width)
    return noise / noise.std()


def driven(steep=(), power=0.0, n=1500):
    """A drive on gentle hidden hills with ``steep`` stretches, and a ``power`` [W] that is taken in their times."""
    rng = np.random.default_rng(11)
    t = np.arange(n) + 0.5
    speed = 18 + 5 * smooth(rng, n + 1, 15.0) + np.cumsum(rng.normal(0, 0.02, n + 1))
    v, a = 0.5 * (speed[:-1] + speed[1:]), np.diff(speed)
    s = np.concatenate([[0.0], np.cumsum(v)])[:-1]
    slope = 0.004 * np.interp(s / 20, np.arange(2000), smooth(rng, 2000, 15.0))  # over 300 m
    slope = slope + sum(size * covered(t, 1.0, ((start, end),)) for start, end, size in steep)
    on = covered(t, 1.0, tuple((start, end) for start, end, _ in STEEP))
    force = M * a + A + C * v**2 + M * STANDARD_GRAVITY * slope + power * on / v + M * rng.normal(0, 6e-3, n)
    context = {Quantity.ELAPSED: t, Quantity.ENGINE_SPEED: 8.0 * v, Quantity.STOPS: np.zeros(n), **past_speeds(v)}
    return made_strides(speed, force, context)


def state_of(strides):
    state = DriveState.of(strides)
    assert state is not None
    return state


@pytest.fixture(scope="module")
def steep():
    """What explains a road with three steep stretches."""
    return Search((state_of(driven(STEEP)),), EFFECTS).result()


@given(spans, spans)
def test_times_that_are_cut_are_those_of_either_and_end_wherever_one_ends(one, other):
    pieces = cut(one, other)
    assert union(pieces, ()) == union(one, other)
    assert {edge for piece in pieces for edge in piece} == {edge for span in (*one, *other) for edge in span}
    assert all(a[1] <= b[0] for a, b in pairwise(pieces))


def test_a_stretch_is_gravity_along_a_slope_in_its_times_alone():
    frame = Frame.of(state_of(driven()).fit)
    (term,) = stretches(frame, ((100.0, 200.0), (200.0, 230.5)))
    columns = term.columns(frame)
    assert columns.shape == (1500, 2)
    assert term.kind is Kind.ROAD
    assert_allclose(columns[100:200, 0], -STANDARD_GRAVITY)
    assert_allclose(columns[230, 1], -0.5 * STANDARD_GRAVITY)
    assert not columns[:100].any()
    assert not columns[231:].any()


def test_the_slope_felt_changes_over_ten_metres():
    frame = Frame.of(state_of(driven()).fit)
    n = len(frame.strides)
    slow = replace(frame, strides=made_strides(np.full(n + 1, 2.0), frame.force, {Quantity.ELAPSED: frame.strides.t}))
    (term,) = stretches(slow, ((100.0, 200.0),))
    share = term.columns(slow)[:, 0] / -STANDARD_GRAVITY
    assert_allclose(share[96:104], [0.0, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0], atol=1e-12)  # 5 s at 2 m/s
    assert_allclose(share[196:204], share[96:104][::-1], atol=1e-12)


@pytest.mark.slow
def test_where_one_stretch_follows_another_the_slope_changes_once():
    frame = Frame.of(state_of(driven()).fit)
    (apart,) = stretches(frame, ((100.0, 200.0), (201.0, 231.0)))
    (joined,) = stretches(frame, ((100.0, 200.0), (200.0, 230.0)))
    assert apart.cost - joined.cost == pytest.approx(CHANGE_COST)


def test_nearly_the_whole_drive_is_no_stretch_of_it():
    frame = Frame.of(state_of(driven()).fit)
    assert not list(stretches(frame, ((0.0, 1450.0),)))
    assert not list(stretches(frame, ()))


@pytest.mark.slow
def test_steep_stretches_are_the_roads(steep):
    (drive,) = steep.drives
    assert steep.chosen == ()
    assert steep.nameless.probability < 0.5
    assert drive.stretches is not None
    joint = drive.joint
    assert len(joint.stretches) == len(drive.stretches.spans or ())
    found = drive.stretches.columns(joint.frame) @ joint.posterior([]).mean[joint.stretches] / -STANDARD_GRAVITY
    for start, end, size in STEEP:
        inside = (drive.fit.strides.t > start + 5) & (drive.fit.strides.t < end - 5)
        assert found[inside].mean() == pytest.approx(size, abs=0.012)
    assert drive.slope_sd == pytest.approx(0.0117, rel=0.15)  # of hills of 0.004 and the stretches
    assert 1 / drive.fit.beta[0] == pytest.approx(M, rel=0.015)


@pytest.mark.slow
def test_in_the_budget_they_are_part_of_the_road(steep):
    found = budget(steep.drives, [[]], [[]], np.random.default_rng(1))
    assert {part.cause for part in found.parts} >= {ROAD}
    assert not any(STRETCHES.name in part.cause for part in found.parts)
    road = found.part(ROAD)
    assert road is not None
    assert road.share > 0.9
    assert road.expected < 0.4 * found.base


@pytest.mark.slow
def test_a_level_road_has_none_of_them(steep):
    (drive,) = steep.drives
    without = replace(drive.fit, terms=())
    hills = log_bayes_factor_of_road(drive.strides, drive.fit)
    assert hills > log_bayes_factor_of_road(drive.strides, without)
    assert hills > 100


@pytest.mark.slow
def test_a_load_of_one_power_in_all_its_times_is_named():
    explained = Search((state_of(driven(power=60e3)),), EFFECTS[:2]).result()
    (choice,) = explained.chosen
    assert choice.name == "auxiliary_cycling"
    assert choice.probability > 0.9
    assert explained.drives[0].magnitudes[0] == pytest.approx(60e3, rel=0.1)


@pytest.mark.slow
def test_one_span_of_more_force_may_be_the_roads():
    """A wet road and a steep one have the same column: over hidden hills no name is given."""
    n = 1500
    strides, on = driven(), covered(np.arange(n) + 0.5, 1.0, ((600.0, 900.0),))
    wet = replace(strides, force=strides.force + (0.35 * A * on)[:, None])
    explained = Search((state_of(wet),), EFFECTS).result()
    assert all(choice.probability < 0.9 for choice in explained.chosen)
