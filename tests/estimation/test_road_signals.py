"""When signals of the road are compared, and what becomes of one that is left out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from dense_road import strides_of

from estimator.checkpoint.validation import StateError
from estimator.config import Config
from estimator.estimates import Coverage, Estimate, Status
from estimator.estimation import road_inference
from estimator.estimation.road_fit import fit, search_of
from estimator.estimation.road_inference import RoadInference
from estimator.estimation.road_signals import contradicted, reversed_in, shown_by
from estimator.estimation.window import Window
from estimator.fleet.drive_result import _Loads


def test_one_signal_alone_is_never_left_out():
    assert contradicted(strides_of(60, shown=("altitude",)), search_of) == ()


def test_a_signal_of_slope_is_reversed_where_it_falls_as_the_road_climbs():
    found = fit(strides_of(70, seed=3, shown=("altitude", "grade", "gravity")))
    assert found is not None
    climbing = replace(found.strides, grade=2.0 + found.slope, gravity=0.5 - 9.8 * found.slope)
    climbing.grade[:5] = np.nan
    assert reversed_in(replace(found, strides=climbing)) == ("gravity",)
    assert reversed_in(replace(found, strides=climbing.without(("grade", "gravity")))) == ()


def test_signals_are_compared_again_where_the_window_has_grown_or_others_have_come(monkeypatch):
    compared = []

    def noted(strides, search_of):
        compared.append(shown_by(strides))
        return ("altitude",) if len(compared) == 3 else ()

    monkeypatch.setattr(road_inference, "contradicted", noted)
    inference = RoadInference(Config(), Window(Config()), np.random.default_rng(1))
    one, two = strides_of(60, shown=("altitude",)), strides_of(60, shown=("altitude", "grade"))
    for strides, held in ((one, 200), (one, 500), (two, 500), (two, 900), (two, 1500), (two, 9000), (one, 9000)):
        inference._fit(strides, held, is_last=False)
    assert compared == [["altitude"], ["altitude", "grade"], ["altitude", "grade"], ["altitude"]]


def test_what_is_left_out_is_kept_with_the_state_and_checked():
    inference = RoadInference(Config(), Window(Config()), np.random.default_rng(1))
    state = inference.state() | {"contradicted": ["altitude"], "signals": ["altitude", "grade"]}
    inference.restore(state)
    assert inference.state()["contradicted"] == ["altitude"]
    with pytest.raises(StateError, match="not those of the road"):
        inference.restore(state | {"contradicted": ["t"]})


def test_a_signal_that_is_left_out_is_not_in_the_road_of_a_fleet_either():
    strides = strides_of(70, seed=3, shown=("altitude", "grade"))
    found = fit(strides.without(("altitude",)))
    assert found is not None
    evidence = SimpleNamespace(fit=replace(found, contradicted=("altitude",)), coefficients=None)
    estimator = SimpleNamespace(segment=0, evidence=evidence, window=SimpleNamespace(strides=strides))
    loads = _Loads(SimpleNamespace(estimator=estimator))
    loads.take(Estimate(t=70.0, status=Status.ESTIMATED, reason="", coverage=Coverage(1, 2), admitted=600))
    kept, of_road = loads._roads[0]
    assert of_road.scales.model_of(kept).reading_names == of_road.scales.readings == ("grade",)
