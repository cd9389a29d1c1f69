"""Places of a learned road in the order in which they are driven, and their figures on the page of a fleet."""

import re

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from estimator.fleet.road import LearnedRoad
from estimator.fleet.road_lines import road_lines
from estimator.fleet.road_page import road_figures
from estimator.road_map import CELL, cells_at, key_of, octant_of
from estimator.signals import Floats
from estimator.units import EARTH_RADIUS

HERE = np.radians([48.0, 11.0])


def passed(north: Floats, east: Floats) -> np.ndarray:
    """Keys of the places along a way [m] (n,), in the order in which they are passed first."""
    latitude = HERE[0] + north / EARTH_RADIUS
    longitude = HERE[1] + east / EARTH_RADIUS / np.cos(HERE[0])
    course = np.arctan2(np.gradient(east), np.gradient(north))
    keys = key_of(*cells_at(latitude, longitude), octant_of(course))
    _, first = np.unique(keys, return_index=True)
    return keys[np.sort(first)]


def road_of(keys: np.ndarray) -> LearnedRoad:
    """Places that ascend from 0 to 4 % in the order in which they are passed."""
    order = np.argsort(keys)
    slope = np.linspace(0.0, 0.04, len(keys))[order]
    ones = np.ones(len(keys))
    return LearnedRoad(
        key=keys[order],
        slope=slope,
        sd=5e-4 * ones,
        common=1e-4 * ones,
        scatter=np.nan * ones,
        passes=np.ones(len(keys), np.int64),
        vehicles=np.ones(len(keys), np.int64),
    )


@pytest.mark.parametrize("bearing", np.radians([0.0, 10.0, 22.5, 45.0, 80.0, 135.0, 200.0, 359.0]))
def test_a_straight_road_is_one_line_in_the_order_of_driving(bearing: float) -> None:
    along = np.arange(0.0, 10_000.0, 10.0)
    keys = passed(along * np.cos(bearing), along * np.sin(bearing))
    line, *_ = road_lines(np.sort(keys), np.ones(len(keys), np.int64))
    assert line.distance[-1] == pytest.approx(10_000, rel=0.06)
    order = np.searchsorted(np.sort(keys), keys)
    places = np.argsort(order)[line.places]  # in the order of driving
    assert np.all(np.diff(places) > 0)


def test_the_two_directions_of_a_road_are_two_lines() -> None:
    along = np.arange(0.0, 5_000.0, 10.0)
    keys = np.unique(np.concatenate([passed(along, 0 * along), passed(along[::-1], 0 * along)]))
    first, second = road_lines(keys, np.ones(len(keys), np.int64))
    assert len(first.places) == len(second.places) == len(keys) / 2


def test_a_ring_has_every_place_once() -> None:
    turn = np.linspace(0, 2 * np.pi, 4000)
    keys = np.sort(passed(1500 * np.cos(turn), 1500 * np.sin(turn)))
    lines = road_lines(keys, np.ones(len(keys), np.int64))
    assert_array_equal(np.sort(np.concatenate([line.places for line in lines])), np.arange(len(keys)))
    assert lines[0].distance[-1] > 0.8 * 2 * np.pi * 1500


def test_a_place_beside_the_road_that_one_vehicle_passed_does_not_end_its_line() -> None:
    along = np.arange(0.0, 5_000.0, 10.0)
    road = passed(along, np.full_like(along, 0.4 * CELL))
    beside = passed(along[200:220], np.full(20, 1.4 * CELL))
    keys = np.concatenate([road, beside])
    order = np.argsort(keys)
    passes = np.concatenate([np.full(len(road), 8), np.ones(len(beside), np.int64)])[order]
    longest = road_lines(keys[order], passes)[0]
    assert_array_equal(keys[order][longest.places], road)


def test_no_place_is_no_line() -> None:
    assert road_lines(np.empty(0, np.int64), np.empty(0, np.int64)) == []


def test_the_figure_shows_the_slope_along_the_road_and_says_where_it_is() -> None:
    along = np.arange(0.0, 5_000.0, 10.0)
    document = road_figures(road_of(passed(along, 0 * along)))
    assert "51 places of 100 m" in document
    assert "the slopes of 51 are certain enough" in document
    assert "line 1: 4.9 km, at first to the north" in document
    assert "from 0.0 to 4.0 %" in document
    assert document.count('class="band after"') == 1
    assert re.search(r">47\.9999, 11\.\d+</td><td[^>]*>48\.04\d+", document)


def test_a_fleet_without_a_road_says_why() -> None:
    assert "not on the bus" in road_figures(road_of(np.empty(0, np.int64)))


def test_places_that_are_too_few_for_a_figure_are_counted() -> None:
    along = np.arange(0.0, 300.0, 10.0)
    document = road_figures(road_of(passed(along, 0 * along)))
    assert "4 places" in document
    assert "road.parquet" in document
    assert "<svg" not in document
