"""Rows without a change of speed and power, however they are cut; and a recording whose last values are repeated."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from simulated_logs import ask, drive

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.samples import STEP, Rows
from estimator.streaming.frozen_rows import LONGEST, USUAL, FrozenRows

MOVES = st.lists(st.tuples(st.sampled_from([0.0, 12.0, 20.0, np.nan]), st.integers(1, 130)), min_size=1, max_size=6)


def rows_of(speed, first=7):
    n = len(speed)
    index, power, fresh = np.arange(first, first + n), np.full(n, 5e4), np.ones((n, 2), bool)
    return Rows(index=index, speed=speed, power=power, fresh=fresh, context={})


@pytest.mark.slow
@given(MOVES, st.data())
def test_rows_of_a_long_stretch_without_a_change_are_frozen_however_they_are_cut(stretches, data):
    """The first half second of a stretch is left to the distance kept from frozen rows."""
    speed = np.concatenate([np.full(count, value) for value, count in stretches])
    rows = rows_of(speed)
    ends = np.flatnonzero(np.append(~(speed[1:] == speed[:-1]), True)) + 1  # nan is another value each time
    expected = np.zeros(len(speed), bool)
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        if speed[first] > 0 and (end - 1 - first) * STEP > LONGEST:
            expected[first + round(USUAL / STEP) + 1 : end] = True
    cuts = sorted(data.draw(st.lists(st.integers(0, len(speed)), max_size=5)))
    follower, found = FrozenRows(), []
    for first, end in zip([0, *cuts], [*cuts, len(speed)], strict=True):
        found += [follower.feed(rows[first:end])] if end > first else []
    whole = Rows.concatenate(*[part for part in [*found, follower.finish()] if part is not None])
    assert_array_equal(whole.index, rows.index)
    assert_array_equal(whole.frozen, expected)


def varied(held, coarse=0.0):
    """Rows of a minute whose power changes in each, but for stretches ``held`` of (first, end); the speed in all."""
    n = 600
    rng = np.random.default_rng(4)
    power = 5e4 + 1e3 * rng.standard_normal(n).cumsum()
    power = power if not coarse else coarse * np.round(power / coarse)
    for first, end in held:
        power[first:end] = power[first]
    speed = 20 + 0.1 * rng.standard_normal(n)
    return replace(rows_of(speed), power=power)


@pytest.mark.slow
@given(st.lists(st.integers(0, 600), max_size=6))
def test_a_power_that_is_held_while_the_speed_changes_is_frozen_however_rows_are_cut(cuts):
    rows, follower, found = varied([(200, 280), (400, 420), (500, 580)]), FrozenRows(), []
    for first, end in zip([0, *sorted(cuts)], [*sorted(cuts), 600], strict=True):
        found += [follower.feed(rows[first:end])] if end > first else []
    whole = Rows.concatenate(*[part for part in [*found, follower.finish()] if part is not None])
    expected = np.zeros(600, bool)
    for first, end in ((200, 280), (500, 580)):
        expected[first + round(USUAL / STEP) + 1 : end] = True
    assert_array_equal(whole.index, rows.index)
    assert_array_equal(whole.frozen, expected)


def test_a_coarse_power_that_often_repeats_itself_is_not_frozen():
    follower = FrozenRows()
    parts = [follower.feed(varied([(200, 280)], coarse=8e3)), follower.finish()]
    assert not any(part.frozen.any() for part in parts if part is not None)


def test_rows_wait_only_while_nothing_changes():
    follower = FrozenRows()
    usual = round(USUAL / STEP)
    assert len(follower.feed(rows_of(20 + 0.01 * np.arange(30.0)))) == 30
    assert len(follower.feed(rows_of(np.full(60, 21.0), 37))) == usual + 1
    assert len(follower.feed(rows_of(np.array([21.1]), 97))) == 60 - usual
    assert follower.finish() is None


def test_rounding_is_no_change_and_a_bit_is_one():
    for step, is_frozen in ((1e-15, True), (4e-5, False)):
        speed = 20.0 * (1 + step * (np.arange(200) % 2))
        whole = FrozenRows().feed(rows_of(speed))
        assert whole.frozen.any() == is_frozen


@pytest.mark.slow
def test_values_that_are_sent_on_when_their_source_is_gone_are_not_used(tmp_path):
    """Ten minutes of a drive, then five with the last frame of every message again at its usual rate."""
    frames = frames_of(drive("mixed", 15, 3).signals)
    first = float(frames.t[0])
    live = frames[frames.t < first + 600]
    moving = frames[(frames.t >= first + 600)]
    last = {ident: live.data[np.flatnonzero(live.ident == ident)[-1]] for ident in np.unique(live.ident).tolist()}
    repeated = replace(moving, data=np.array([last.get(ident, 0) for ident in moving.ident.tolist()], dtype=np.uint8))
    whole, part = tmp_path / "frozen.blf", tmp_path / "live.blf"
    write_log(Frames.concatenate([live, repeated]), whole)
    write_log(live, part)
    found, alone = ask("estimate", whole), ask("estimate", part)
    assert found["samples"]["rejected"]["speed and power frozen"] > 2800
    mass, expected = found["parameters"]["mass_kg"], alone["parameters"]["mass_kg"]
    assert mass["mean"] == pytest.approx(expected["mean"], abs=expected["sd"])
