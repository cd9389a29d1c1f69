"""The page of a fleet, and its seasons: the truth of made fleets is in them, whatever logs and vehicles are called."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_page import opened
from made_fleets import FIRST, WINTER_DRAG, Case, made, page_of

from estimator.config import Config
from estimator.diagnosis.result import HIDDEN_GRADE, SHOWN_SLOPE
from estimator.fleet.drive_result import FoundEffect
from estimator.fleet.engine import Serial
from estimator.fleet.page import _changes, _in_per_cent, _of_all
from estimator.fleet.rows import effect_rows
from estimator.fleet.run import conclude
from estimator.fleet.seasons import SEASONS, season_of
from estimator.report.page.plot import DateAxis


@pytest.fixture(scope="module")
def year() -> Case:
    """Six vehicles over a year, C of one too high, and each drive diagnosed."""
    return made(6, 24, 4, days=15.0, outlier="truck-05", with_diagnosis=True)


def test_a_season_is_three_months_of_any_year() -> None:
    assert {season_of(FIRST), season_of(FIRST - 30 * 86_400), season_of(FIRST + 366 * 86_400)} == {SEASONS[0]}
    assert [season_of(FIRST + 91.5 * n * 86_400) for n in range(1, 5)] == [*SEASONS[1:], SEASONS[0]]
    assert season_of(0.0) == ""


def test_seasons_recover_what_winter_does_to_drag(year: Case) -> None:
    ratios, vehicles = [], year.fleet.vehicles
    for vehicle, seasons in zip(vehicles, year.fleet.seasons, strict=True):
        assert [one.season for one in seasons] == list(SEASONS)
        assert sum(one.loads for one in seasons) == len(vehicle.masses)
        drags = [one.drag for one in seasons if one.drag is not None]
        assert len(drags) == len(SEASONS)
        ratios.append(drags[0].mean / np.mean([drag.mean for drag in drags[1:]]))
    assert np.median(ratios) == pytest.approx(WINTER_DRAG, abs=0.04)
    first_harmonic = 0.072  # January above July, as a share of C: of 8 % in three of 12 months
    seen = [(one.winter[1], one.drag) for one in vehicles if one.winter is not None and one.drag is not None]
    assert len(seen) == len(vehicles)
    above = np.array([(*winter, drag.mean) for winter, drag in seen])  # mean, sd, C
    assert np.abs((above[:, 0] - first_harmonic * above[:, 2]) / above[:, 1]).max() < 2.5
    assert np.median(above[:, 0]) > 0


def test_a_change_by_season_is_of_vehicles_with_several_seasons() -> None:
    rng = np.random.default_rng(1)
    values, sds = np.array([110.0, 80.0, 110.0]), np.array([3.0, 5.0, 2.0])
    found = _in_per_cent(dict(zip("abc", zip(values.tolist(), sds.tolist(), strict=True), strict=True)))
    assert [change for change, _ in found.values()] == pytest.approx([10.0, -20.0, 10.0])
    drawn = rng.normal(0.0, sds, (100_000, 3))
    assert [sd for _, sd in found.values()] == pytest.approx(
        (drawn - drawn.mean(axis=1)[:, None]).std(axis=0), rel=0.02
    )
    both = {"a": {"x": (5.0, 1.0), "y": (-5.0, 1.0)}, "b": {"x": (7.0, 1.0), "y": (-7.0, 1.0)}, "c": {"y": (0.0, 1.0)}}
    assert "+6.0" in _changes(both, ["x", "y"]).split("</tr>")[1]


def test_a_season_of_all_drives_is_the_vehicle_itself() -> None:
    case = made(2, 3, 1)
    for vehicle, (season,) in zip(case.fleet.vehicles, case.fleet.seasons, strict=True):
        assert (season.season, season.loads) == (SEASONS[0], 3)
        assert (season.rolling, season.drag) == (vehicle.rolling, vehicle.drag)


def test_loads_without_a_set_clock_are_in_no_season() -> None:
    case = made(1, 4, 1)
    segment = replace(case.fleet.results[0].segments[0], start=100.0)
    unset = replace(case.fleet.results[0], segments=(segment,))
    fleet = conclude(case.fleet.grouped, (unset, *case.fleet.results[1:]), Config(), Serial())
    assert [one.loads for one in fleet.seasons[0]] == [3]
    assert len(fleet.vehicles[0].masses) == 4


def test_the_page_says_what_the_tables_do(year: Case) -> None:
    document = page_of(year.fleet)
    (more,) = re.findall(r"<h1>truck-05 has (\d+) % more drag</h1>", document)
    assert '<p class="reason">6 vehicles, 144 drives, 144 h. ' in document
    assert '<p class="verdict">1 vehicle out of line</p>' in document
    (outlier,) = re.findall(r'<table class="data outliers">.*?</table>', document)
    assert "truck-05" in outlier
    assert re.findall(r"\+(\d+) %", outlier) == [more]
    assert 25 < float(more) < 50
    assert document.count('<li class="out">') == 1
    assert document.count('<li class="in">') == 11  # A/m of six vehicles, and C of the five others
    assert document.count("h0") >= 144  # a dot a load
    effects = len(effect_rows(year.fleet))
    assert f"effect {effects}" in document
    assert f">{effects:,}</td>" in document
    assert all(season in document for season in SEASONS)


def test_the_vehicles_whose_drag_is_known_are_counted_of_all() -> None:
    assert [_of_all(*counts) for counts in ((1, 1), (6, 6), (5, 6), (0, 6))] == [
        "1 vehicle",
        "6 vehicles",
        "5 of 6 vehicles",
        "no vehicle",
    ]
    assert "The mass is known of 1 load, C of 1 vehicle." in page_of(made(1, 1, 4).fleet)


def test_a_grade_has_one_size_whether_signals_show_it_or_not() -> None:
    case = made(1, 3, 4, with_diagnosis=True)
    grade = FoundEffect(
        name="grade", probability=1.0, log_bayes_factor=40.0, quantity=SHOWN_SLOPE, magnitude=0.02, sd=0.001, unit="1"
    )
    hidden = replace(grade, quantity=HIDDEN_GRADE, magnitude=0.01)
    results = tuple(
        replace(one, verdict="effect", effects=(each,))
        for one, each in zip(case.fleet.results, (grade, hidden, grade), strict=True)
    )
    (gaps,) = re.findall(r'<table class="data gaps">.*?</table>', page_of(replace(case.fleet, results=results)))
    rows = [re.findall(r">([^<>]+)</t[hd]>", row) for row in gaps.split("<tr>")[2:]]
    assert [(row[0], row[-1]) for row in rows] == [
        ("grade, shown by signals", "sd of the grade 2.00 %"),
        ("grade, shown by no signal", "sd of the grade 1.00 %"),
    ]


def test_names_are_no_markup_and_the_page_loads_nothing(year: Case) -> None:
    document = page_of(year.fleet)
    assert "&lt;cut&gt;.blf" in document
    assert "<cut>" not in document
    assert "default-src 'none'" in document
    assert not re.search(r"<script|https?://|src=|url\(", document)


@pytest.mark.parametrize(("vehicles", "drives"), [(1, 1), (3, 2)])
def test_a_small_fleet_has_a_page_that_says_what_is_missing(vehicles: int, drives: int) -> None:
    document = page_of(made(vehicles, drives, 2).fleet)
    assert f", {60 * vehicles * drives} min</h1>" in document
    assert "Too few vehicles" in document
    assert "were not diagnosed" in document
    assert "All drives are in one season, Dec to Feb" in document


def test_a_reason_that_one_log_has_is_shown_with_its_numbers(year: Case) -> None:
    document = page_of(year.fleet)
    assert "cut at byte 700" in document


def test_drives_that_are_not_joined_are_on_the_page() -> None:
    case = made(2, 4, 2)
    first, *others = case.fleet.grouped.drives
    grouped = replace(case.fleet.grouped, drives=(replace(first, end=first.start + 4 * 86_400), *others), notes={})
    document = page_of(conclude(grouped, case.fleet.results, Config(), Serial()))
    assert "<li>truck-01: 1 of its drives overlaps others in time: two vehicles in one folder? give --vehicle</li>" in (
        document
    )
    assert "8 in all, given all drives of its vehicle where they are joined" in document  # those of truck-01 too
    one = replace(grouped, drives=grouped.drives[:4])
    alone = page_of(conclude(one, case.fleet.results[:4], Config(), Serial()))
    assert "No vehicle has A/m or C estimated yet: 1 of its drives overlaps others in time" in alone


def test_a_fleet_without_an_estimate_has_a_page() -> None:
    case = made(2, 2, 2)
    failed = tuple(
        replace(one, segments=(), fault=f"source: missing inputs: speed {i}")
        for i, one in enumerate(case.fleet.results)
    )
    document = page_of(conclude(case.fleet.grouped, failed, Config(), Serial()))
    assert "No vehicle has A/m or C estimated yet" in document
    assert "missing inputs: speed …" in document
    assert "4 failed" in document


@pytest.mark.parametrize(
    ("days", "labels"),
    [
        (6.0, ["10 Jan", "11 Jan", "12 Jan", "13 Jan", "14 Jan", "15 Jan", "16 Jan"]),
        (200.0, ["Feb", "Mar", "Apr", "May", "Jun", "Jul"]),
        (300.0, ["Mar", "May", "Jul", "Sep", "Nov"]),
        (1300.0, ["Jan 2025", "Jan 2026", "Jan 2027"]),
    ],
)
def test_days_are_labelled_as_dates(days: float, labels: list[str]) -> None:
    first = np.floor(FIRST / 86_400)
    x = DateAxis(first, first + days, "")
    assert [x.text(tick) for tick in x.ticks(8).tolist()] == labels


@pytest.mark.slow
@pytest.mark.parametrize("width", [1100, 400])
def test_the_page_opens_in_a_browser(browser: Any, year: Case, tmp_path: Path, width: int) -> None:
    path = tmp_path / "fleet.html"
    path.write_text(page_of(year.fleet), "utf-8")
    with opened(browser, path, width) as tab:
        assert tab.evaluate(
            "[...document.querySelectorAll('.track')].every(e => e.getBoundingClientRect().width > 100)"
        )
