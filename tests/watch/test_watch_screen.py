"""The screen of `watch` on terminals of all sizes, and the words in it."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_estimates import made_estimate
from made_views import BEGUN, CELLS, OCCUPIED, WANTED, begun, estimated
from rich.console import Console

from estimator.answers.run import Coverage
from estimator.answers.watch import WatchAnswer
from estimator.report import usual_units, wanted_driving
from estimator.report.history import MOST, History
from estimator.roles import Role
from estimator.watch import view
from estimator.watch.coverage_map import ASCII, BLOCKS, MAX_ACROSS
from estimator.watch.screen import Screen, sparkline

VIEWS = {"estimated": estimated(), "begun": begun(), "lost": view.without_news("status.json", "no daemon", "x" * 300)}


def shown(seen: WatchAnswer, width: int = 80, height: int = 24, address: str = "") -> list[str]:
    """Lines of the screen, without blanks at their ends."""
    console = Console(width=width, height=height, color_system=None, force_terminal=True)
    with console.capture() as capture:
        console.print(Screen(seen, address), end="")
    return [line.rstrip() for line in capture.get().splitlines()]


@given(st.sampled_from(sorted(VIEWS)), st.integers(20, 220), st.integers(3, 70))
def test_the_screen_fits_any_terminal(name: str, width: int, height: int) -> None:
    lines = shown(VIEWS[name], width, height)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width


@pytest.mark.parametrize("width", [20, 40, 80])
def test_mass_and_map_are_readable(width: int) -> None:
    text = "\n".join(shown(estimated(), width))
    assert "27,190 kg" in text
    assert BLOCKS.cells[3] in text
    assert "coverage 60 % (54 of" in text
    if width >= 40:
        assert "26,743 .. 27,637" in text
        assert "braking 7 %" in text


def test_a_wide_screen_says_everything() -> None:
    text = " ".join(" ".join(shown(estimated(), 120, 30, "http://127.0.0.1:8000/")).split())
    rates = ("drive.blf", "playing 43 %", "0:08:12", "12,345 frames/s", "http://127.0.0.1:8000/", "km/h", "m/s²")
    numbers = ("1,739 N", "3.740 N s²/m²", "120 m climbed", "9,000 used", "standing 3 %", "concluded 0:00:12 ago")
    for words in (*rates, *numbers):
        assert words in text


def test_behind_a_plus_minus_is_a_standard_deviation() -> None:
    """As in every other answer; the made parameters have one of 1 %."""
    text = "\n".join(shown(estimated(), 120, 30))
    assert text.count("± 1.00 %") == 3


def test_every_cell_of_the_map_is_drawn_in_its_state() -> None:
    lines = shown(estimated(), 100, 30)
    plan = "".join(line[50:] for line in lines if "enough" not in line)
    counts = [plan.count(glyph) / MAX_ACROSS for glyph in reversed(BLOCKS.cells[1:])]
    assert counts == [OCCUPIED, BEGUN, WANTED]


def test_a_terminal_without_blocks_gets_letters() -> None:
    console = Console(width=80, height=24, color_system=None, force_terminal=True, legacy_windows=False)
    options = console.options.copy()
    options.encoding = "ascii"
    text = "".join(segment.text for segment in console.render(Screen(estimated()), options))
    assert ASCII.cells[3] * MAX_ACROSS in text
    assert not set(text) & set(BLOCKS.cells[1:] + BLOCKS.heights) - set(ASCII.cells)


def test_names_cannot_command_the_terminal() -> None:
    text = "\n".join(shown(estimated(source="\x1b[31mred\x07.blf", unused={"\x1b]0;x\x07": 500})))
    assert "\x1b" not in text
    assert "\x07" not in text


def test_a_narrowing_interval_falls() -> None:
    chart = sparkline([100.0, 50.0, 20.0, 10.0, 5.0], 5)
    assert list(chart) == sorted(chart, reverse=True)
    assert (chart[0], chart[-1]) == (BLOCKS.heights[-1], BLOCKS.heights[0])
    assert sparkline([100.0, 50.0, 20.0], 2) == BLOCKS.heights[-1] + BLOCKS.heights[0]
    assert sparkline([1.0], 5) == sparkline([1.0, 2.0], 0) == ""


def test_what_the_first_estimate_waits_for() -> None:
    assert begun().sentences.headline == "no estimate yet: 450 of 600 usable samples"
    assert begun("torque has the wrong sign", 900).sentences.headline == "no estimate yet: torque has the wrong sign"
    progress = begun(samples=900).progress
    assert progress is not None
    steps = wanted_driving.steps_to_estimate
    assert steps(progress, Coverage(fraction=0.5, occupied=5, available=10)) == "5 of 8 cells of speed and acceleration"
    assert steps(progress, Coverage(fraction=0.1, occupied=9, available=90)) == "coverage 10 % of the 15 % needed"
    assert steps(progress, Coverage(fraction=0.6, occupied=54, available=90)) == ""


def test_what_is_wanted_is_said_as_a_driver_would() -> None:
    assert wanted_driving.wanted(CELLS) == (
        "accelerating gently at 60 to 80 km/h (2 cells), accelerating gently at 0 to 20 km/h (1)"
    )
    filled = msgspec.structs.replace(CELLS, rows=tuple((i, j, 10) for i, j in CELLS.wanted))
    assert wanted_driving.wanted(filled) == ""


def test_signals_are_read_in_usual_units() -> None:
    assert usual_units.between(Role.SPEED, 0.0, 25.0) == "0 .. 90 km/h"
    assert usual_units.between(Role.AMBIENT_TEMPERATURE, 273.15, 288.15) == "0 .. 15 °C"
    assert usual_units.between(Role.HEADING, 0.0, np.pi) == "0 .. 180 °"
    assert usual_units.between(Role.YAW_RATE, -np.pi, np.pi) == "-180 .. 180 °/s"
    assert usual_units.between(Role.ENGINE_SPEED, 0.0, 20 * np.pi) == "0 .. 600 rpm"
    assert usual_units.between(Role.GEAR, 1.0, 12.0) == "1 .. 12"
    places = {
        (25.0, 30.0, "m/s"): ("90 km/h", "108 km/h"),
        (18.4, 20.56, "m/s"): ("66.2 km/h", "74.0 km/h"),
        (-0.12, 0.3, "m/s^2"): ("\N{MINUS SIGN}0.12 m/s²", "0.30 m/s²"),
        (15.38, 15.42, "degC"): ("15.380 °C", "15.420 °C"),
        (45.0, 90.0, "deg"): ("45°", "90°"),
        (3.0, 4.0, ""): ("3", "4"),
        (1200.0, 1743.5, "s"): ("0:20:00", "0:29:04"),
    }
    assert {place: usual_units.ends(*place) for place in places} == places
    for role in Role:
        assert usual_units.between(role, 0.0, 1.0)


def test_the_history_is_bounded_and_keeps_the_newest() -> None:
    history = History()
    for minute in range(10 * MOST):
        history.add(made_estimate(60.0 * minute + 7.0), start=7.0)
        times = [point.t_s for point in history.points]
        assert len(times) <= MOST
        assert times == sorted(times)
        assert times[-1] == 60.0 * minute
    assert times[0] < 600.0
    history.add(made_estimate(0.0), start=0.0)  # time has stepped back: another drive
    assert len(history.points) == 1
