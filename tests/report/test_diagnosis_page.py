"""A diagnosis as a page, as JSON and on the terminal."""

import dataclasses
import html
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser_page import opened
from diagnoses import empty, finding, rich, several, unknown
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from estimator.answers import diagnosis as answer
from estimator.answers.answer import decode, encode
from estimator.answers.diagnosis import Verdict
from estimator.commands.diagnosis_tables import print_diagnosis
from estimator.components.budget import ROAD, Budget, Part
from estimator.diagnosis.result import (
    HIDDEN_GRADE,
    SHOWN_SLOPE,
    Advice,
    Diagnosis,
    GapClosed,
    Isolability,
    Magnitude,
    NotTestable,
    Shift,
    Traces,
)
from estimator.diagnosis.thresholds import Thresholds
from estimator.errors import ConfigError, RoadloadError
from estimator.report import number_format, wording
from estimator.report.diagnosis_page import page, terms, write_page
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.report.page import figures, tables
from estimator.report.traces_file import write_traces

DIAGNOSES = {"rich": rich, "several": several, "unknown": unknown, "empty": empty}
FINDING_KEYS = {
    "name", "probability", "log_bayes_factor", "equivalent", "magnitude", "gap_closed", "rms_before_kW",
    "rms_after_kW", "parameter_shift",
}  # fmt: skip
CONTRACT = {
    "verdict", "effects", "candidates", "remaining", "noise_floor_kW", "rms_base_kW", "rms_final_kW", "where",
    "isolability", "not_testable",
}  # fmt: skip


# JSON

ROAD_PART = Part(
    cause=ROAD,
    is_given=False,
    share=1.0,
    q05=0.97,
    q95=1.01,
    rms=7_400.0,
    held_out_rms=2_900.0,
    expected=1_700.0,
    closed=(1.0, 1.0, 1.0),
)


@pytest.mark.parametrize("name", DIAGNOSES)
def test_json_keeps_the_contract(name: str) -> None:
    content = json.loads(encode(of_diagnosis(DIAGNOSES[name]())))
    assert content.keys() >= CONTRACT
    assert content["remaining"].keys() == {"verdict", "log_bayes_factor", "formula"}
    for effect in content["effects"] + content["candidates"]:
        assert effect.keys() >= FINDING_KEYS
        assert effect["magnitude"].keys() == {"name", "value", "sd", "unit"}
    for place in content["where"]:
        assert place.keys() == {"axis", "from", "to", "unit", "bias_kW", "share", "q_value"}
    for pair in content["isolability"]["pairs"]:
        assert pair.keys() >= {"a", "b", "distance"}


def test_json_gives_kilowatts_and_distances() -> None:
    d = rich()
    said = of_diagnosis(d)
    wind = said.effects[0]
    assert (said.rms_base_kW, said.noise_floor_kW, wind.rms_after_kW) == (13.4, 3.3, 7.6)
    assert wind.gap_closed == answer.GapClosed(fraction=0.712, q05=0.66, q95=0.755)
    assert wind.parameter_shift == answer.RoadLoad(mass_kg=-120.0, A_N=85.0, C_N_s2_m2=-0.21)
    assert said.where[0].bias_kW == pytest.approx(14.2)
    names = len(d.isolability.names)
    assert len(said.isolability.pairs) == names * (names - 1) / 2
    same = dataclasses.replace(
        d, isolability=Isolability(("a", "b", "c"), np.array([[1, -1, 0], [-1, 1, 0], [0, 0, 1]]), np.zeros(3))
    )
    assert [pair.distance for pair in of_diagnosis(same).isolability.pairs] == [0, 1, 1]


def test_json_says_null_for_what_is_not_known() -> None:
    odd = finding("fan", np.nan, magnitude=Magnitude("x", np.inf, np.nan, ""), gap_closed=GapClosed(np.nan, 0.1, 0.2))
    d = Diagnosis(verdict=Verdict.EFFECT, effects=(odd,), noise_floor=np.nan, rms_base=np.float64(2000.0))
    said = decode(encode(of_diagnosis(d)), answer.DiagnosisAnswer)
    (effect,) = said.effects
    assert (effect.probability, effect.magnitude.value, effect.gap_closed.fraction) == (None, None, None)
    assert (said.noise_floor_kW, said.rms_base_kW, said.rms_final_kW) == (None, 2.0, None)


def test_json_says_which_log_a_time_belongs_to() -> None:
    said = of_diagnosis(several())
    wind, fan = said.effects
    assert fan.span_s == ((420.0, 520.0), (427.0, 527.0), (1127.0, 1227.0))
    assert fan.span_log == (0, 1, 1)
    assert (wind.span_s, wind.span_log) == ((), ())
    assert said.logs == ("monday.blf", "tuesday.blf")


def test_rows_of_power_have_the_number_of_the_log_that_text_and_page_say(tmp_path: Path) -> None:
    d = several()
    write_traces(d.traces, tmp_path / "traces.csv")
    table = np.genfromtxt(tmp_path / "traces.csv", delimiter=",", names=True)
    assert sorted(set(table["log"])) == [1, 2]
    assert "log 1: monday.blf, log 2: tuesday.blf" in page(d)


def test_parameters_say_which_of_several_drives_they_are_of() -> None:
    d = several()
    said = of_diagnosis(d).parameters
    assert (said.log, said.span_s) == (0, (0.0, 4_500.0))
    assert (
        page(d).count("Of the drive with most usable driving, log 1 0:00:00 to 1:15:00.") == 3
    )  # parameters, courses, unseen
    console = Console(file=io.StringIO(), width=200)
    print_diagnosis(console, d)
    assert "of the drive with most usable driving, log 1 0:00:00 to 1:15:00" in console.file.getvalue()
    assert "usable driving" not in page(rich())
    assert of_diagnosis(rich()).parameters.log is None


# page


def test_the_p_value_is_on_page_and_terminal() -> None:
    console = Console(file=io.StringIO(), width=200)
    print_diagnosis(console, changed(p_value=0.01))
    assert "0.01: how often noise alone" in console.file.getvalue()
    assert "p value 0.01: how often noise alone gives an effect as much evidence" in page(changed(p_value=0.01))
    assert "noise alone" not in page(rich())


def test_a_doubt_that_logs_are_of_one_vehicle_is_on_the_page() -> None:
    assert '<p class="note">The reference torque is another in log 2: two vehicles?</p>' in page(several())
    assert 'class="note"' not in page(rich()).split("</header>")[0].split("<header")[1]


def test_the_terms_say_the_rules_that_the_diagnosis_is_made_by() -> None:
    said = terms(Thresholds(min_probability=0.75, min_class_correlation=0.88, min_expected_log_bf=7.5))
    assert "named from 75 % on" in said["probability"]
    assert "named by its probability" in said["log Bayes factor"]
    assert "from 88 on they cannot be told apart" in said["isolability"]
    assert "below 7.5 it would go unnoticed" in said["visible?"]
    shown = page(rich())
    for meaning in terms(Thresholds()).values():
        assert f"<dd>{meaning}</dd>" in shown


class Skeleton(HTMLParser):
    """Tags with the names of their attributes, and the text between them."""

    def __init__(self, document: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, tuple[str, ...]]] = []
        self.texts: list[str] = []
        self.feed(document)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, tuple(name for name, _ in attrs)))

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def named(text: str) -> Diagnosis:
    """A diagnosis in which everything that can come from outside is ``text``."""
    d, places = rich(), rich().where[:1]
    effect = dataclasses.replace(d.effects[0], name=text, detail=text, equivalent=(text,))
    effect = dataclasses.replace(effect, magnitude=Magnitude(text, 1.0, 0.1, text))
    return dataclasses.replace(
        d,
        effects=(effect,),
        candidates=(effect,),
        where=(dataclasses.replace(places[0], axis=text, unit=text),),
        isolability=Isolability((text, text), np.ones((2, 2)), np.ones(2)),
        not_testable=(NotTestable(text, text),),
        invisible=(dataclasses.replace(d.invisible[0], name=text, shown_by=text),),
        advice=(Advice(text, text),),
        streaming_effects=(text,),
        traces=None,
        logs=(text,),
    )


BENIGN = Skeleton(page(named("benign"))).tags


@pytest.mark.slow
@given(
    st.text(min_size=1).filter(lambda text: text != number_format.NOTHING)
    | st.sampled_from(
        [
            "</style><script>alert(1)</script>",
            '"><img src=x onerror=alert(1)>',
            "' onload='x",
            "&lt;b&gt;",
            "<!--",
            "]]>",
        ]
    )
)
@settings(deadline=None, max_examples=60)
def test_no_name_changes_the_page(text: str) -> None:
    skeleton = Skeleton(page(named(text)))
    assert skeleton.tags == BENIGN
    assert skeleton.texts.count(text) >= 2  # name and detail of the effect


def changed(**values: object) -> Diagnosis:
    return dataclasses.replace(rich(), **values)  # type: ignore[arg-type]


SLOPES = Magnitude(HIDDEN_GRADE, 0.0142, 0.001, "1")
HILLS = dataclasses.replace(finding("grade", 0.99, magnitude=SLOPES), rms_before=13.4e3, rms_after=3.3e3)
RIVALS = (finding("drafting", 0.6, equivalent=("fan",)),)


def test_a_probability_stands_beside_the_names_that_it_is_of() -> None:
    either = finding("warm_up", 0.97, equivalent=("oil_warm_up",))
    assert "<h3>warm up (or oil warm up)</h3>" in page(changed(effects=(either,)))


def test_evidence_that_is_not_reported_has_its_reason() -> None:
    reason = "too little beside effects whose form is not exact"
    assert reason not in page(changed(remaining_log_bayes_factor=1.2))
    assert f"+18, {reason}" in page(changed(remaining_log_bayes_factor=18.0))
    assert reason not in page(changed(remaining_log_bayes_factor=18.0, remaining_verdict=Verdict.UNKNOWN))
    alone = changed(remaining_log_bayes_factor=18.0, effects=(), verdict=Verdict.NO_GAP)
    assert reason not in page(alone)


@pytest.mark.parametrize(
    ("d", "sentence"),
    [
        (empty(), "Cannot tell: the log holds 40 s of driving; ten minutes are needed."),
        (
            changed(verdict=Verdict.NO_GAP, effects=()),
            "The model describes this drive to 13.4 kW; too small to see here: viscous drag, auxiliary load.",
        ),
        (unknown(), "Something is missing that no known effect explains: power over time, 6.1 kW of 9.1 kW."),
        (
            changed(verdict=Verdict.CANNOT_TELL, effects=RIVALS),
            "The drive shows drafting or fan, and cannot tell which.",
        ),
        (
            changed(verdict=Verdict.CANNOT_TELL, effects=(), doubtful="fan"),
            "There may be fan, too weak on this drive to be sure.",
        ),
        (
            changed(verdict=Verdict.CANNOT_TELL, effects=(finding("drafting", 0.6),)),
            "There may be drafting, too weak on this drive to be sure.",
        ),
        (
            changed(verdict=Verdict.CANNOT_TELL, effects=(finding("drafting", 0.6, equivalent=("unknown effect",)),)),
            "The drive shows drafting or unknown effect, and cannot tell which.",
        ),
        (
            changed(effects=(HILLS,)),
            "A force varies with place like a grade of 1.4 % sd, and no signal on the bus shows it: with one, the "
            "residual could fall from 13.4 kW to 3.3 kW; roadload estimate counts with such a road by itself.",
        ),
        (
            rich(),
            "With headwind (wind 5.21 ± 0.32 m/s) and auxiliary cycling (power 23.4 ± 1.1 kW) in the model "
            "the residual falls from 13.4 kW to 3.6 kW.",
        ),
    ],
)
def test_the_reason_states_the_facts(d: Diagnosis, sentence: str) -> None:
    assert wording.reason(d) == sentence


def test_the_steps_of_the_residual_begin_with_the_power_as_it_came() -> None:
    fan = finding("auxiliary_cycling", 1.0, rms_before=3_900.0, rms_after=3_000.0)
    late = finding("time_lag", 1.0, rms_before=4_680.0, rms_after=3_900.0)
    d = dataclasses.replace(
        empty(), obstacle="", verdict=Verdict.EFFECT, effects=(fan, late), rms_base=4_680.0, rms_final=3_000.0
    )
    steps = [("plain model", 4_680.0), ("+ time lag", 3_900.0), ("+ auxiliary cycling", 3_000.0)]
    assert wording.ladder(d) == steps
    assert wording.reason(d).endswith("in the model the residual falls from 4.7 kW to 3.0 kW.")
    worse = dataclasses.replace(d, rms_final=4_800.0)
    assert wording.reason(worse).endswith("does not fall on stretches kept from the fit (4.7 kW, then 4.8 kW).")
    alone = dataclasses.replace(d, effects=(fan,), rms_base=3_900.0)
    assert wording.ladder(alone) == [("plain model", 3_900.0), steps[2]]


def test_a_road_that_no_signal_shows_is_a_step_by_the_force_alone() -> None:
    fan = finding("auxiliary_cycling", 1.0, rms_before=13.4e3, rms_after=2_500.0)
    budget = Budget(base=13.4e3, held_out_rms=2_500.0, parts=(ROAD_PART,))
    d = changed(effects=(HILLS, fan), rms_base=13.4e3, rms_final=2_500.0, budget=budget)
    steps = [("plain model", 13.4e3), ("+ grade by the force alone", 2_900.0), ("+ auxiliary cycling", 2_500.0)]
    assert wording.ladder(d) == steps
    assert wording.ladder(dataclasses.replace(d, budget=None)) == [steps[0], steps[2]]
    none = dataclasses.replace(fan, gap_closed=GapClosed(0.0, 0.0, 0.0))
    assert wording.closes(d, none) == "closes 0 % of the gap, takes the residual from 2.9 kW to 2.5 kW"
    assert wording.closes(d, fan) == "takes the residual from 2.9 kW to 2.5 kW"
    assert wording.closes(d, HILLS) == ""


def test_a_known_road_is_no_step_where_it_leaves_an_effect_aside() -> None:
    """It has a list of its own, and its name says of which model it is: in bars, curves, map, caption and text."""
    fan = finding("auxiliary_cycling", 1.0, rms_after=2_500.0)
    d = changed(effects=(HILLS, fan), rms_base=13.4e3, rms_final=2_500.0)
    steps, apart = figures.bars(d).split("</ul>")[:2]
    assert drawn(steps) == [("plain model", 13.4e3), ("+ auxiliary cycling", 2_500.0), ("noise floor", 3_300.0)]
    name = "if the road were known, without auxiliary cycling"
    said = of_diagnosis(d)
    assert drawn(apart) == [(f"plain model {name}", 1e3 * said.effects[0].rms_after_kW)]
    assert "For comparison, no further step:" in apart
    assert figures.improved(d, d.traces).name == name
    document = page(d)
    assert f"The plain model {name}: expected with true slopes." in document
    assert f"The residual is 2.5 kW (that of the plain model is 3.3 kW {name})" in document
    assert document.count(f"Residual, {name}, over") == 2  # alternative texts, and that of the map
    assert f"Gap map, {name}: " in document
    assert "the residual of the plain model, without auxiliary cycling, could fall from 13.4 kW to 3.3 kW" in document


def test_a_known_road_says_that_a_lag_is_taken_out() -> None:
    late = finding("time_lag", 1.0, rms_before=14e3, rms_after=13.4e3)
    assert wording.road_known(changed(effects=(HILLS, late)))[0] == "if the road were known, time lag taken out"
    assert wording.road_known(changed(effects=(HILLS,))) == ("if the road were known", HILLS.rms_after)
    assert wording.road_known(rich()) is None


def drawn(bars: str) -> list[tuple[str, float]]:
    """Names and residuals [W] of the bars, whose widths must be in the ratio of the numbers beside them."""
    rows = re.findall(r"<li><span>(.*?)</span>(.*?)<span>([\d.]+) kW</span></li>", bars)
    widths = [sum(map(float, re.findall(r"width:([\d.]+)%", row))) for _, row, _ in rows]
    powers = [1e3 * float(power) for _, _, power in rows]
    assert widths == pytest.approx([100 * power / 13.4e3 for power in powers], abs=0.11)
    return [(name, power) for (name, _, _), power in zip(rows, powers, strict=True)]


def test_the_caption_of_the_bars_says_what_each_is_of() -> None:
    """The residual of the plain model is of the whole drive, as it is fitted to it."""
    said = page(rich())
    assert "over held-out stretches" not in said
    assert "fitted to the whole drive. Effects are judged on stretches left out of the fit" in said
    assert "Gap closed: share in all that was found" in said
    alone = page(changed(effects=(), verdict=Verdict.NO_GAP))
    assert "left out of the fit" not in alone.split('id="how-far"')[1].split("</section>")[0]


def test_bytes_that_are_no_text_are_written(tmp_path: Path) -> None:
    write_page(dataclasses.replace(empty(), logs=("drive\udcff.blf",)), tmp_path / "a.html")
    assert "drive?.blf" in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_page_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"a\.pdf: write it as one of \.html"):
        write_page(rich(), tmp_path / "a.pdf")
    with pytest.raises(ConfigError, match="no folder"):
        write_page(rich(), tmp_path / "missing" / "a.html")
    (tmp_path / "a.html").write_text("an older page")

    def full(path: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(RoadloadError, match=r"a\.html: cannot write: No space left on device"):
        write_page(rich(), tmp_path / "a.html")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.html", "an older page")]


def test_page_is_small_and_the_same_twice() -> None:
    assert len(page(rich()).encode()) < 300_000
    assert page(rich()) == page(rich())


def test_folded_rows_are_not_said_to_be_less_than_those_shown() -> None:
    """Rows of one probability in tenths of a per cent are ordered by their evidence."""
    near = [finding(name, 0.0006 + 1e-4 * i, log_bayes_factor=-1.0 * i) for i, name in enumerate("abcdefghij")]
    text = tables.ranking(changed(effects=(), candidates=tuple(near[:8])).ranking + tuple(near[8:]), False)
    assert "<summary>2 more</summary>" in text
    assert "less probable" not in page(rich())


def test_gap_map_tells_each_cell() -> None:
    d = rich()
    cells = np.isfinite(d.gap_map.plain).sum() + np.isfinite(d.gap_map.extended).sum()
    assert page(d).count('<rect class="cell') == cells
    worst = np.unravel_index(np.nanargmax(d.gap_map.plain), d.gap_map.plain.shape)
    assert f": {d.gap_map.plain[worst] / 1e3:+.1f} kW, {d.gap_map.samples[worst]:,.0f} samples" in page(d)


def test_power_shows_the_minutes_that_say_most() -> None:
    t = np.arange(3600.0)
    flat = np.full(3600, 50e3)
    measured = flat + 20e3 * ((t > 2400) & (t < 2640))
    traces = Traces(
        t=t,
        distance=20 * t,
        speed=flat / 2500,
        acceleration=0 * t,
        measured=measured,
        base=flat,
        extended=measured,
        road_known=measured,
        log=0 * t,
    )
    d = dataclasses.replace(rich(), traces=traces, gap_map=None)
    assert 'aria-label="Power from 0:38:59 to 0:43:59' in page(d)


def test_all_times_of_a_page_are_of_one_clock() -> None:
    said = page(rich())
    assert "0:07:00 to 0:08:40, 0:18:40 to 0:20:20, 0:30:20 to 0:32:00 and 3 more" in said
    assert re.findall(
        r'<th scope="row">time</th><td data-label="from">(.*?)</td><td data-label="to">(.*?)</td>', said
    ) == [("0:07:00", "0:08:40")]
    assert "[min]" not in said
    assert "time since the first frame [h:mm]" in said


def test_effects_that_run_alike_are_said_to_be_inseparable() -> None:
    apart = page(rich()).split('id="apart"')[1].split("</section>")[0]
    assert "Which effects cannot be told apart here?" in apart
    assert "Their powers run alike on this drive: viscous drag and auxiliary load." in apart
    names = ("headwind", "grade")
    two = changed(isolability=Isolability(names, np.eye(2), np.zeros(2)))
    assert "No two effects have powers that run alike on this drive." in page(two)


def test_the_residuals_of_the_budget_are_said_to_be_of_one_cause_alone() -> None:
    """Beside them the steps of the ladder add the effects to each other."""
    d = changed(budget=Budget(base=13.4e3, held_out_rms=4e3, parts=(ROAD_PART,)))
    assert "Both residuals at the right are of one cause alone; below, effects are added one to the other." in page(d)
    assert '<th scope="col">left once added alone</th>' in page(d)
    assert "left once added alone" in printed(d)
    assert "left if known alone" in printed(d)


def test_a_break_between_two_logs_is_cut_out() -> None:
    d = rich()
    t = np.concatenate([d.traces.t, d.traces.t + 3 * 86_400])
    columns = {field.name: np.tile(getattr(d.traces, field.name), 2) for field in dataclasses.fields(Traces)}
    twice = Traces(**columns | {"t": t})
    document = page(dataclasses.replace(d, traces=twice))
    assert "driving time [h:mm], long breaks left out" in document
    assert "driving time" not in page(d)


def test_several_logs_are_drawn_one_after_the_other() -> None:
    d = several()
    document = page(d)
    assert "driving time [h:mm], log after log" in document
    assert "log 1: monday.blf, log 2: tuesday.blf" in document
    assert "log 1 0:07:00 to 0:08:40, log 2 0:07:07 to 0:08:47, 0:18:47 to 0:20:27" in document
    # The first log is 75 minutes long: each shaded time lies in its own, from left to right.
    strip = document.split('class="plot strip"')[1]
    left = [float(x) for x in re.findall(r'class="span" x="([0-9.]+)"', strip)]
    assert left == sorted(left)
    assert left[0] < 1000 * 10 / 115 < 1000 * 75 / 115 < left[1]
    assert wording.action(d.effects[1], several=True) in " ".join(printed(d, 400).split())


@pytest.mark.parametrize("count", [0, 1, 2, 50])
@pytest.mark.parametrize("value", [0.0, 5.0, np.nan])
def test_traces_without_extent_leave_a_page(count: int, value: float) -> None:
    level = np.full(count, value)
    traces = Traces(
        t=np.arange(count) * 1.0,
        distance=level,
        speed=level,
        acceleration=level,
        measured=level,
        base=level,
        extended=level,
        road_known=level,
        log=np.zeros(count),
    )
    document = page(dataclasses.replace(rich(), traces=traces, noise_floor=value))
    assert ("Power, measured" in document) == (count >= 2 and np.isfinite(value))
    assert "Which effect?" in document


@pytest.mark.parametrize("name", DIAGNOSES)
def test_headline_and_reason_come_first(name: str) -> None:
    d = DIAGNOSES[name]()
    texts = Skeleton(page(d)).texts
    first = texts.index(d.verdict.value)
    assert texts[first : first + 3] == [d.verdict.value, wording.headline(d), wording.reason(d)]


# in a browser


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("name", DIAGNOSES)
def test_page_opens_in_a_browser(browser: object, tmp_path: Path, name: str, width: int) -> None:
    d, path = DIAGNOSES[name](), tmp_path / "report.html"
    write_page(d, path)
    with opened(browser, path, width) as tab:
        assert tab.locator("h1").inner_text() == wording.headline(d)
        plots = tab.locator(".plot").all()
        assert len(plots) == {"rich": 8, "several": 8, "unknown": 5, "empty": 0}[name]
        for plot in plots:
            box = plot.locator("svg").bounding_box()
            assert box["width"] > 250
            assert box["height"] > 150
            assert plot.get_by_role("img").get_attribute("aria-label")
            assert plot.locator(".area span").count() >= 4
        assert tab.evaluate("[...document.querySelectorAll('.line')].every(l => l.getBoundingClientRect().width > 50)")


# terminal


def printed(d: Diagnosis, width: int = 120) -> str:
    stream = io.StringIO()
    print_diagnosis(Console(file=stream, width=width), d)
    return stream.getvalue()


def test_terminal_says_all_in_a_screenful() -> None:
    text = printed(rich())
    assert text.startswith("Headwind and auxiliary cycling (or resistance segment) account for 99 % of the gap.\n")
    assert len(text.splitlines()) <= 30
    for part in ("wind 5.21 ± 0.32 m/s", "71 % (66 to 76 %)", "noise floor 3.3 kW", "coolant temperature", "gps_speed"):
        assert part in text
    assert text.endswith('add to the configuration: effects = ["headwind", "auxiliary_cycling"]\n')


def test_an_estimate_that_cannot_have_what_was_found_is_not_advised() -> None:
    timed = ("headwind", "auxiliary_cycling")
    d = dataclasses.replace(rich(), streaming_effects=(), beyond_streaming=timed, deviation=Shift(210.0, 42.0, 0.12))
    said = "o signal shows when headwind and auxiliary cycling act, so roadload estimate cannot have them: take mass, A"
    assert said in " ".join(printed(d, 400).split())
    assert said in page(d)
    assert "add to the configuration" not in printed(d).lower() + page(d).lower()
    final, sd = d.final, d.deviation
    assert final is not None
    assert sd is not None
    assert f"with the effects mass {final.mass:,.0f} ± {sd.mass:,.0f} kg, A {final.A:,.0f} ±" in printed(d, 400)


def test_terminal_of_a_log_that_cannot_tell() -> None:
    assert printed(empty()).splitlines() == [wording.headline(empty()), wording.reason(empty())]


@pytest.mark.parametrize("text", ["[bold]x[/bold]", "[/]", "[link=x]"])
def test_terminal_prints_names_as_they_are(text: str) -> None:
    assert printed(named(text), 400).count(text) >= 8


# words


@pytest.mark.parametrize(
    ("fraction", "words"),
    [(0.914, "91 %"), (1.0, "100 %"), (0.0, "0 %"), (0.9962, "99.6 %"), (0.99999, "> 99.9 %"), (0.004, "0.4 %"),
     (1e-7, "< 0.1 %"), (-0.123, "\N{MINUS SIGN}12 %"), (np.nan, number_format.NOTHING)],
)  # fmt: skip
def test_percent(fraction: float, words: str) -> None:
    assert wording.percent(fraction) == words


@pytest.mark.parametrize(
    ("closed", "words"),
    [((0.712, 0.66, 0.755), "71 % (66 to 76 %)"),
     ((0.9273, 0.9262, 0.9291), "92.7 % (92.6 to 92.9 %)"), ((0.001, 0.0, 0.002), "0.1 % (0.0 to 0.2 %)"),
     ((0.99999, 0.9999, 1.0), "> 99.9 %"), ((0.0, 0.0, 0.0), "0 %"), ((np.nan, 0.0, 0.0), number_format.NOTHING)],
)  # fmt: skip
def test_the_ends_of_an_interval_differ(closed: tuple[float, float, float], words: str) -> None:
    assert wording.interval(GapClosed(*closed)) == words


@pytest.mark.parametrize(
    ("watts", "words"),
    [(14_230.0, "14.2 kW"), (999.9, "1.00 kW"), (215.0, "0.21 kW"), (96.0, "0.096 kW"), (0.0, "0.000 kW")],
)
def test_a_power_has_two_digits(watts: float, words: str) -> None:
    assert wording.kilowatts(watts) == words


def test_without_effects_the_parameters_are_those_averaged_over_hypotheses() -> None:
    final, sd = Shift(mass=23_983.0, A=1_500.0, C=3.4), Shift(mass=81.0, A=40.0, C=0.2)
    text = tables.parameters(changed(effects=(), final=final, deviation=sd))
    assert "averaged over the hypotheses" in text
    assert "23,983 ± 81" in text
    assert text.count("<tr>") == 4


def test_a_gap_that_is_a_small_part_of_the_residual_is_said_to_be() -> None:
    small = changed(effects=(finding("drafting", 0.95, gap_closed=GapClosed(0.97, 0.5, 1.0)),), noise_floor=13_200.0)
    assert wording.headline(small) == "Drafting accounts for 97 % of the gap, which is 3 % of the residual."
    assert "residual" not in wording.headline(rich())
    hardly = dataclasses.replace(small, rms_final=13_370.0)
    assert wording.reason(hardly).endswith("in the model the residual falls by 0.4 % in mean square, from 13.4 kW.")


@pytest.mark.parametrize(
    ("magnitude", "words"),
    [(Magnitude("wind", 6.123, 0.41, "m/s"), "wind 6.12 ± 0.41 m/s"),
     (Magnitude("loss", 0.0123, 0.0021, ""), "loss 0.0123 ± 0.0021"),
     (Magnitude("mass", -4512.3, 120.0, "kg"), "mass \N{MINUS SIGN}4,510 ± 120 kg"),
     (Magnitude("lag", 0.25, np.nan, "s"), "lag 0.250 s")],
)  # fmt: skip
def test_size_has_the_digits_it_deserves(magnitude: Magnitude, words: str) -> None:
    assert wording.size(magnitude) == words


def test_a_shift_has_the_digits_that_its_sd_deserves():
    change = Shift(mass=498.3, A=-815.2, C=2.9612)
    assert wording.shift(change) == f"mass +498 kg, A {number_format.MINUS}815 N, C +2.961"
    rough = wording.shift(change, Shift(mass=150.0, A=63.0, C=0.15))
    assert rough == f"mass +500 kg, A {number_format.MINUS}820 N, C +3.0"
    assert wording.shift(Shift(mass=0.2, A=20.0, C=0.0), Shift(mass=150.0, A=63.0, C=0.15)) == "A +20 N"


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_any_number_can_be_written(x: float) -> None:
    for text in (number_format.number(x), wording.percent(x), wording.kilowatts(x), wording.bayes(x)):
        assert text
        assert "nan" not in text
        assert "inf" not in text
        assert not text.startswith("-")


def test_the_size_of_hills_is_one_quantity_whether_signals_show_them_or_not() -> None:
    shown = dataclasses.replace(SLOPES, name=SHOWN_SLOPE)
    assert wording.size(shown) == wording.size(SLOPES) == "sd of the grade 1.42 ± 0.10 %"


def test_gap_closed_of_several_effects_is_the_sum_of_their_shares() -> None:
    assert wording.gap_closed(rich()) == pytest.approx(0.712 + 0.276)
    assert wording.gap_closed(dataclasses.replace(rich(), effects=rich().effects[:1])) == 0.712
    assert wording.gap_closed(unknown()) is None


def test_a_formula_is_told_where_nothing_has_a_name() -> None:
    told = wording.formula(unknown())
    assert told.startswith("(4.10 ± 0.12 W/m) v t follows it ")
    assert told.endswith("with it 84 % of the squared residual is gone on stretches left out of the fit")
    assert told in html.unescape(page(unknown()))
    assert wording.formula(rich()) == ""
    formula = of_diagnosis(unknown()).remaining.formula
    assert formula is not None
    assert (formula.text, formula.unit, formula.share) == ("v t", "W/m", 0.84)
    assert of_diagnosis(rich()).remaining.formula is None
