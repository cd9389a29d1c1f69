"""One drive, one fit, one result: what is stated, drawn and estimated is of one model."""

import re
from dataclasses import replace as with_fields
from pathlib import Path

import numpy as np
import pytest
from project_paths import ROOT
from simulated_logs import CLIMB, drive, written

from estimator.components.drive_state import DriveState
from estimator.config import from_dict, load, replace
from estimator.diagnosis.case import Case
from estimator.diagnosis.result import HIDDEN_GRADE, Diagnosis
from estimator.model.effects import BY_NAME
from estimator.report import wording
from estimator.report.diagnosis_page import page
from estimator.report.diagnosis_plots import gap
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.settings import Bus
from estimator.simulation.effects.effect import Effect
from estimator.streaming.drive_extraction import diagnose_logs, drives_of
from estimator.streaming.replay import estimate_logs

pytestmark = pytest.mark.slow

HILLS = Effect(name="grade", magnitude=0.01)
ONCE = {"gate": {"interval_s": 1e6}}  # one update, of the whole drive


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def mean_square(d: Diagnosis, which: str) -> float:
    """Of the cells of the map, each as often as it was driven."""
    assert d.gap_map is not None
    values, times = getattr(d.gap_map, which), d.gap_map.samples
    seen = np.isfinite(values)
    return float(np.average(values[seen] ** 2, weights=times[seen]))


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = drive("mixed", 15, 7, HILLS, altitude_noise=0.5)
    return written(recording, tmp_path_factory.mktemp("shown") / "hills.blf")


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = drive("mixed", 15, 7, HILLS, without=CLIMB)
    return written(recording, tmp_path_factory.mktemp("hidden") / "hills.blf")


@pytest.fixture(scope="module")
def diagnosed(shown: Path) -> Diagnosis:
    return diagnose_logs(shown, from_dict({}))


def test_hills_that_an_altimeter_shows_are_drawn_as_they_are_stated(diagnosed):
    d = diagnosed
    assert [effect.name for effect in d.effects] == ["grade"]
    traces = d.traces
    assert rms(traces.measured - traces.base) == pytest.approx(d.rms_base, rel=1e-9)
    assert rms(traces.measured - traces.extended) == pytest.approx(d.rms_final, rel=1e-9)
    share = 1 - (d.rms_final / d.rms_base) ** 2
    assert share > 0.8
    assert mean_square(d, "extended") < (1 - 0.9 * share) * mean_square(d, "plain")


def test_hills_that_no_signal_shows_are_drawn_as_if_they_were_known(hidden):
    """What a signal could reach is one number: of the text, the bar, the budget, the JSON and the curve."""
    d = diagnose_logs(hidden, from_dict({}))
    (grade,) = d.effects
    assert (d.verdict, grade.name, d.streaming_effects) == ("effect", "grade", ())
    assert grade.magnitude.value == pytest.approx(HILLS.magnitude, rel=0.5)  # what can be foretold of it
    assert "no signal" in grade.detail
    assert any("altitude" in advice.shown_by for advice in d.advice)
    traces = d.traces
    assert rms(traces.measured - traces.base) == pytest.approx(d.rms_base, rel=1e-9) == grade.rms_before
    known = rms(traces.measured - traces.road_known)
    document = page(d)
    assert "if the road were known" in document
    assert "with the effects" not in document.split("What it does to the parameters")[0]
    assert known == pytest.approx(grade.rms_after, rel=1e-9) == d.budget.part("road").expected
    assert grade.rms_after < 0.3 * grade.rms_before
    stated = f"{wording.kilowatts(known)} if the road were known"
    assert stated in document
    assert f"to {wording.kilowatts(known)}" in wording.reason(d)
    assert mean_square(d, "extended") < 0.3 * mean_square(d, "plain")


def test_a_known_road_is_told_apart_from_an_effect_beside_it(tmp_path: Path) -> None:
    """What it leaves is of the model without the effect: in bars, picture, text, JSON and curve, under that name."""
    recording = drive("mixed", 20, 7, HILLS, Effect(name="auxiliary_cycling", magnitude=40e3), without=CLIMB)
    d = diagnose_logs(written(recording, tmp_path / "hidden.blf"), from_dict({}))
    grade, fan = d.effects
    assert (grade.magnitude.name, fan.name) == (HIDDEN_GRADE, "auxiliary_cycling")
    assert d.rms_final < grade.rms_after
    name, known = "if the road were known, without auxiliary cycling", wording.kilowatts(grade.rms_after)
    assert 1e3 * of_diagnosis(d).effects[0].rms_after_kW == pytest.approx(grade.rms_after)
    assert rms(d.traces.measured - d.traces.road_known) == pytest.approx(grade.rms_after, rel=1e-9)
    lists = re.findall(r'<ul class="bars".*?</ul>', page(d))
    steps, apart = (re.findall(r"<li><span>(.*?)</span>.*?<span>(.*?)</span></li>", each) for each in lists)
    told = [*wording.ladder(d), ("noise floor", d.noise_floor)]
    assert steps == [(step, wording.kilowatts(power)) for step, power in told]
    assert apart == [(f"plain model {name}", known)]
    assert [panel.get_title(loc="left") for panel in gap(d).axes][1] == f"{name}: {known} rms"


def test_a_known_road_leaves_what_an_exact_altimeter_leaves(hidden, tmp_path):
    """An effect that is possible, but was not found, takes no part in it."""
    exact = written(drive("mixed", 15, 7, HILLS, altitude_noise=0.01), tmp_path / "exact.blf")
    found = diagnose_logs(exact, from_dict({}))
    (grade,) = diagnose_logs(hidden, from_dict({})).effects
    assert grade.rms_after == pytest.approx(found.budget.part("road").expected, rel=0.1)
    assert grade.rms_after == pytest.approx(found.noise_floor, rel=0.1)


def test_the_plain_model_is_the_one_whose_parameters_are_given(diagnosed):
    d = diagnosed
    v, a = d.traces.speed, d.traces.acceleration
    power = (d.base.A + d.base.C * v**2 + d.base.mass * a) * v
    assert rms(power - d.traces.base) < 0.2 * rms(d.traces.base)  # but for the lag and the drag of the engine


@pytest.mark.parametrize("kind", ["shown", "hidden"])
def test_estimate_and_diagnosis_fit_a_drive_alike(kind, request):
    log = request.getfixturevalue(kind)
    evidence = estimate_logs(log, from_dict(ONCE)).pipeline.estimator.evidence
    (made,) = drives_of(log, from_dict({}))
    state = DriveState.of(made.strides, made.rests)
    fit = evidence.fit
    assert len(state.fit.strides) == len(fit.strides)
    assert state.fit.scales.values.tolist() == fit.scales.values.tolist()
    assert state.fit.equations.solve()[0].tolist() == fit.equations.solve()[0].tolist()


@pytest.mark.nightly
def test_a_real_trip_is_drawn_as_it_is_stated(recordings):
    folder = recordings / "bmw_i3"
    settings = load(ROOT / "dbc" / "bmw_i3.toml")
    d = diagnose_logs(folder / "TripA06.blf", replace(settings, bus=Bus(dbc=[str(folder / "bmw_i3.dbc")])))
    assert d.effects
    assert rms(d.traces.measured - d.traces.base) == pytest.approx(d.rms_base, rel=1e-9)
    assert rms(d.traces.measured - d.traces.extended) == pytest.approx(d.rms_final, rel=1e-9)


def test_the_page_of_a_drive_whose_hills_are_given_is_of_the_model_with_them(shown, diagnosed):
    """The base is then the model with the road: its name, its parameters and what an exact road would leave."""
    d = diagnose_logs(shown, from_dict({"effects": ["grade"]}))
    assert (d.verdict, d.given, d.effects) == ("no gap", ("grade",), ())
    assert d.rms_base == pytest.approx(diagnosed.rms_final, rel=1e-9)
    assert d.base.mass == pytest.approx(diagnosed.final.mass, rel=0.01) == d.final.mass
    assert abs(d.base.mass - diagnosed.base.mass) > 0.05 * d.base.mass  # of a level road
    document = page(d)
    assert "plain model" not in document
    assert "Parameters of the model with grade" in document
    assert f"{d.final.mass:,.0f}" in document
    bars = re.search(r'<ul class="bars".*?</ul>', document).group()
    road = d.budget.part("road")
    rows = [("model with grade", d.rms_base), ("if its road were exact", road.expected), ("noise floor", d.noise_floor)]
    assert re.findall(r"<li><span>(.*?)</span>.*?<span>(.*?)</span></li>", bars) == [
        (name, wording.kilowatts(power)) for name, power in rows
    ]
    assert ">error of road<" in document


def test_a_given_wind_gets_the_shape_that_fits_beside_what_is_found(tmp_path: Path) -> None:
    """A shape found without the other effects leaves them another wind to explain."""
    log = written(drive("mixed", 15, 7, Effect(name="headwind", magnitude=5.0)), tmp_path / "wind.blf")
    (made,) = drives_of(log, from_dict({"effects": ["headwind"]}))
    case = Case.of(made, (BY_NAME["headwind"],))
    direction, *rest = case.terms[0].shape
    turned = with_fields(case, terms=(with_fields(case.terms[0], shape=(direction + 0.5, *rest)),))
    found = turned.state(is_level=True)
    nearer = turned.beside(found)
    assert nearer.state(is_level=True).log_evidence > found.log_evidence + 1
    own = case.state(is_level=True)
    assert case.beside(own).state(is_level=True).log_evidence >= own.log_evidence - 0.1
