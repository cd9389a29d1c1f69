"""Found scales mean the same noise wherever they are used: their operating point goes with them."""

from dataclasses import replace

import numpy as np
import pytest
from dense_road import MIDDLE, scales_of, strides_of
from numpy.testing import assert_allclose, assert_array_equal

from estimator.errors import StateError
from estimator.estimation.road_fit import fit_given
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
    assert moved.lost[0].point == OTHER


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


def test_a_state_gives_the_scales_back():
    scales = replace(found_on(strides_of(seed=2), True), turns=((10.0, 20.0),), designed=True, power_chance=0.25)
    back = RoadScales.restored(scales.state())
    assert_array_equal(back.values, scales.values)
    assert replace(back, values=scales.values) == scales


@pytest.mark.parametrize("point", [[100.0, 7.0], [100.0, 0.0, 10.0], [100.0, np.nan, 10.0], [100.0, 7.0, 10.0, 1.0]])
def test_a_state_with_another_point_is_refused(point):
    state = found_on(strides_of(seed=2), True).state() | {"point": np.array(point)}
    with pytest.raises(StateError, match=r"not those of a road model|point"):
        RoadScales.restored(state)
