"""The record of a drive for the diagnosis: what pieces of rows become, and that they stay as they were."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from estimator.config import Config
from estimator.preparation.drive import Drive
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Quantity, Role

LENGTH = 1500  # rows of a piece


def piece(first: int, **context: Floats) -> Rows:
    t = (first + np.arange(LENGTH)) * STEP
    speed = 15 + 5 * np.sin(2 * np.pi * t / 60)
    power = (20e3 * np.gradient(speed, STEP) + 1500 + 3 * speed**2) * speed
    known = {Role(name): values for name, values in context.items()}
    return Rows(
        index=first + np.arange(LENGTH),
        speed=speed,
        power=power,
        fresh=np.ones((LENGTH, 2), dtype=bool),
        context={Role.ENGINE_SPEED: np.full(LENGTH, 120.0), **known},
    )


def without(values: Floats, *unknown: slice) -> Floats:
    values = values.copy()
    for each in unknown:
        values[each] = np.nan
    return values


@pytest.fixture
def constant() -> Callable[[float], Floats]:
    return lambda value: np.full(LENGTH, value)


def test_rows_stay_as_they_were(constant: Callable[[float], Floats]) -> None:
    """What is filled in for the context is no measurement: admission sees the gaps."""
    engine = without(constant(120.0), slice(500, 800))
    pieces = [piece(0, engine_speed=engine)]
    Drive.of(pieces, Config())
    assert_array_equal(pieces[0].context[Role.ENGINE_SPEED], engine)


def test_a_quantity_that_one_piece_lacks_takes_no_stride_of_it(constant: Callable[[float], Floats]) -> None:
    heading, nothing = constant(1.0), constant(np.nan)
    whole = Drive.of([piece(first, heading=heading) for first in (0, 5000, 10_000)], Config())
    parts = [piece(first, heading=known) for first, known in ((0, heading), (5000, nothing), (10_000, heading))]
    parted = Drive.of(parts, Config())
    assert len(parted.strides) == len(whole.strides) > LENGTH / 10
    assert_array_equal(parted.strides.context[Quantity.HEADING], whole.strides.context[Quantity.HEADING])


def test_a_heading_is_bridged_the_short_way_through_north(constant: Callable[[float], Floats]) -> None:
    east_of_north, gap = np.where(np.arange(LENGTH) < 800, np.radians(358), np.radians(2)), slice(700, 900)
    made = Drive.of([piece(0, heading=without(east_of_north, gap))], Config())
    assert np.all(np.cos(made.strides.context[Quantity.HEADING]) > np.cos(np.radians(2.01)))


def test_a_state_is_held_until_the_next(constant: Callable[[float], Floats]) -> None:
    gear = np.where(np.arange(LENGTH) < 800, 8.0, 10.0)
    made = Drive.of([piece(0, gear=without(gear, slice(700, 900)))], Config())
    assert set(made.strides.context[Quantity.GEAR]) == {8.0, 10.0}
