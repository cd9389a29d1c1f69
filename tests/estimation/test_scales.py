"""Found scales mean the same noise wherever they are used: their operating point goes with them."""

from dataclasses import replace

import numpy as np
import pytest
from dense_road import MIDDLE, scales_of, strides_of
from made_strides import made_strides
from numpy.testing import assert_allclose, assert_array_equal

from estimator.errors import StateError
from estimator.estimation.road_fit import fit, fit_given
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.scales import RoadScales
from estimator.model.road import ROUGH, RoadModel
from estimator.model.road_scales import POWER, SCALES, OperatingPoint
from estimator.strides import Strides

ROAD_LOAD = np.array([1500.0, 3.5, 20e3])
OTHER = OperatingPoint(turns=90.0, gearing=7.3, speed=11.0)


def found_on(strides: Strides, power: bool, shown: tuple[str, ...] = ()) -> RoadScales:
    model = RoadModel(strides, 2, ROUGH, power)
    values = scales_of(model, seed=4)
    if not power:
        values[POWER] = SCALES[POWER].low
    point = model.references.point
    return RoadScales(values=values, point=point, alpha=2, wander=ROUGH, readings=shown, lag=MIDDLE)


@pytest.mark.parametrize("power", [True, False])
def test_at_another_point_the_same_noise_has_other_scales(power):
    strides = strides_of(seed=2)
    strides.gearing[::7] = np.nan  # the engine's speed is not known there
    scales = found_on(strides, power)
    moved = scales.at(OTHER)
    assert moved.has_power is power
    assert moved.values[0] / scales.values[0] == pytest.approx(OTHER.gearing / scales.point.gearing)
    evidence = [
        Likelihood(each.model_of(strides), (), ROAD_LOAD, each.lag).log_evidence(each.values)
        for each in (scales, moved, moved.at(scales.point))
    ]
    assert_allclose(evidence, evidence[0], rtol=1e-12)
    assert_allclose(moved.at(scales.point).values, scales.values)


def test_those_lost_move_too():
    scales = found_on(strides_of(seed=2), True)
    moved = replace(scales, lost=(scales,)).at(OTHER)
    assert_array_equal(moved.lost[0].values, moved.values)
    assert moved.lost[0].point == moved.point == replace(OTHER, turns=scales.point.turns)


@pytest.mark.parametrize("power", [True, False])
def test_the_scales_of_one_part_of_a_drive_are_the_same_noise_in_a_part_driven_in_another_gear(power):
    strides = strides_of(400, seed=5, silence=400)
    early, late = strides[:150], replace(strides[150:], gearing=0.6 * strides.gearing[150:])
    scales = found_on(early, power)
    point = OperatingPoint.of(late[late.known])
    assert point.gearing < 0.8 * scales.point.gearing
    here, there = fit_given(late, scales), fit_given(late, scales.at(point))
    assert here is not None
    assert there is not None
    assert_allclose(here.beta, there.beta, rtol=1e-6)
    assert_allclose(here.covariance, there.covariance, rtol=1e-6, atol=1e-9 * np.abs(there.covariance).max())
    unlike = fit_given(late, replace(scales, point=point))
    assert unlike is not None
    assert abs(unlike.mass_sd / here.mass_sd - 1) > 0.01


def test_noise_of_the_power_near_its_bound_keeps_its_order():
    scales = found_on(strides_of(seed=2), True)
    scales.values[POWER] = 1.01 * SCALES[POWER].low
    moved = scales.at(replace(OTHER, speed=3.0 * scales.point.speed))
    assert moved.has_power
    assert moved.values[POWER] == pytest.approx(SCALES[POWER].low)


def test_scales_of_driving_without_an_engine_speed_are_those_of_any_point():
    """Gearings then have no unit: the scales hold at the medians of whatever strides they are used on."""
    strides = strides_of(300, seed=5, silence=300)
    strides.gearing[:] = np.nan
    found = fit(strides)
    assert found is not None
    assert found.scales.point is None
    later = replace(strides, gearing=strides_of(300, seed=5, silence=300).gearing)
    assert_allclose(found.scales.at(OTHER).values, found.scales.values)
    model = found.scales.model_of(later)
    assert model.references.point == OperatingPoint.of(later[later.known])
    assert np.median(model.weight) == pytest.approx(1.0, rel=0.1)


def in_two_gears() -> tuple[Strides, Strides]:
    """Parts of a drive in a low and in a high gear, with noise of the torque that is proportional to the gearing."""
    n, rng = 700, np.random.default_rng(6)
    speed = 14.0 + 4.0 * np.sin(np.arange(n + 1) / 35) + np.cumsum(rng.normal(0.0, 0.05, n + 1))
    v, gearing = 0.5 * (speed[1:] + speed[:-1]), np.where(np.arange(n) < 350, 16.0, 6.0)
    force = 20e3 * np.diff(speed) + 1500.0 + 3.5 * v**2 + 20e3 * 0.004 * gearing * rng.normal(size=n)
    made = replace(made_strides(speed, force, {}), gearing=gearing)
    return made[:350], made[350:]


def test_a_search_from_scales_of_another_gear_finds_those_of_a_fresh_one():
    early, late = in_two_gears()
    before = fit(early)
    assert before is not None
    fresh, found = fit(late), fit(late, known=before.scales)
    assert fresh is not None
    assert found is not None
    assert found.references.point == found.scales.point
    assert found.scales.point.gearing == fresh.scales.point.gearing == 6.0
    assert found.scales.values[0] == pytest.approx(fresh.scales.values[0], rel=0.2)
    assert found.mass_sd == pytest.approx(fresh.mass_sd, rel=0.1)
    again = fit_given(late, found.scales)
    assert again is not None
    assert_allclose(again.beta[:3], found.beta[:3], rtol=1e-3)
    assert again.mass_sd == pytest.approx(found.mass_sd, rel=0.01)


def test_a_state_gives_the_scales_back():
    scales = replace(found_on(strides_of(seed=2), True), turns=((10.0, 20.0),), designed=True, power_chance=0.25)
    back = RoadScales.restored(scales.state())
    assert_array_equal(back.values, scales.values)
    assert replace(back, values=scales.values) == scales


def test_so_does_one_without_a_point():
    scales = replace(found_on(strides_of(seed=2), True), point=None)
    assert RoadScales.restored(scales.state()).point is None


@pytest.mark.parametrize("change", [{"gearing": 0.0}, {"turns": -1.0}, {"speed": np.nan}, {"speed": "10"}])
def test_a_state_with_another_point_is_refused(change):
    state = found_on(strides_of(seed=2), True).state()
    with pytest.raises(StateError, match=r"point|speed"):
        RoadScales.restored(state | {"point": state["point"] | change})
