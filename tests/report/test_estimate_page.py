"""The page of an estimate: what is drawn is what the JSON says, at any width, with any name."""

import dataclasses
import re
from html.parser import HTMLParser
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_page import opened
from made_outputs import made_view
from simulated_logs import ask, drive, written

from estimator.answers.run import CoverageMap
from estimator.config import Config
from estimator.errors import ConfigError
from estimator.estimates import Coverage, Estimate, Marginal, Status
from estimator.report.estimate_page import page, write_page
from estimator.report.estimate_view import EstimateView, evidence_of, view_of
from estimator.report.parameter_text import ROWS
from estimator.streaming.replay import estimate_logs

# Of a plot: its ticks as pairs of position [0, 1] and number, and the points of the path of a class, both ways.
DRAWN = """(plot, kind) => {
  const ticks = (name, side) => [...plot.querySelectorAll(".area span." + name)].map(
    s => [parseFloat(s.style[side]) / 100, s.innerText]);
  const d = plot.querySelector("svg path." + kind).getAttribute("d");
  const points = [...d.matchAll(/[ML]([-0-9.]+) ([-0-9.]+)/g)].map(m => [m[1] / 1000, 1 - m[2] / 1000]);
  return {x: ticks("x", "left"), y: ticks("y", "bottom"), points};
}"""


class Tags(HTMLParser):
    """Fails where tags do not close in order; keeps what a page loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [
            value or "" for name, value in attrs if name in ("src", "href") and not (value or "").startswith("#")
        ]
        if tag not in ("meta", "link", "br", "!doctype"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def unestimated() -> EstimateView:
    """A drive without an estimate, of which the driven cells are known."""
    nothing = Estimate(
        t=made_view().start + 60.0,
        status=Status.UNESTIMATED,
        reason="450 usable samples of the 600 needed, <so far>",
        coverage=Coverage(0, 0),
        admitted=450,
    )
    return dataclasses.replace(made_view(), updates=(nothing,), evidence=None, warnings=())


def empty() -> EstimateView:
    """Nothing at all."""
    none = CoverageMap(
        speed_step_m_s=0.5,
        acceleration_step_m_s2=0.1,
        lowest_acceleration_m_s2=-1.0,
        needed=10,
        rows=(),
        wanted=(),
    )
    return dataclasses.replace(unestimated(), cells=none)


def numbers(text: str) -> list[float]:
    """The numbers in a text."""
    return [float(x.replace(",", "")) for x in re.findall(r"\d[\d,]*\.?\d*", text)]


def curve(plot: Any, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Abscissae and ordinates of the points of a path, read by the labels of the axes."""
    drawn = plot.evaluate(DRAWN, kind)
    points = np.array(drawn["points"])
    scales = []
    for side, column in (("x", 0), ("y", 1)):
        at = np.array([place for place, _ in drawn[side]])
        values = [
            seconds(label) if ":" in label else float(label.replace("\N{MINUS SIGN}", "-")) for _, label in drawn[side]
        ]
        slope, offset = np.polyfit(at, values, 1)
        scales.append(offset + slope * points[:, column])
    return scales[0], scales[1]


def seconds(label: str) -> float:
    """``0:05`` or ``0:05:30``."""
    parts = [*map(int, label.split(":")), 0]
    return 3600.0 * parts[0] + 60 * parts[1] + parts[2]


VIEWS = {
    "estimated": (made_view, 13),
    "once": (lambda: made_view(1), 6),
    "unestimated": (unestimated, 1),
    "empty": (empty, 0),
}
BY_DAY = [  # a view, a width and a scheme of the browser
    ("estimated", 1280, "light"),
    ("estimated", 400, "dark"),
    ("once", 400, "light"),
    ("unestimated", 1280, "dark"),
    ("empty", 400, "light"),
]


@pytest.mark.parametrize("name", VIEWS)
def test_the_page_is_whole_and_loads_nothing(name: str) -> None:
    text = page(VIEWS[name][0]())
    tags = Tags(text)
    assert tags.open == []
    assert tags.loaded == []
    assert "NaN" not in text
    assert ">nan" not in text


def test_names_are_shown_as_they_are(tmp_path: Path) -> None:
    view = dataclasses.replace(made_view(), title="<b>a</b> & $x$ \udcff.blf")
    write_page(view, tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert "&lt;b&gt;a&lt;/b&gt; &amp; $x$ ?.blf" in text
    assert "a &lt;warning&gt;" in text


def test_a_page_has_a_suffix_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a\.htm"):
        write_page(made_view(), tmp_path / "a.htm")


def test_what_is_withheld_is_said_with_its_reason() -> None:
    text = page(made_view(1))
    assert "A unestimated: too uncertain &lt;yet&gt;" in text
    assert "Rolling resistance unestimated; drag unestimated." in text
    assert "c_rr</th>" not in text


def test_effects_in_the_model_are_told_with_their_sizes() -> None:
    view = made_view()
    wind = Marginal(mean=5.743, sd=0.19, q05=5.435, q50=5.743, q95=6.047)
    sizes = {"headwind": wind, "unbound_friction": Marginal(mean=90.0, sd=3.0, q05=85.0, q50=90.0, q95=95.0)}
    final = dataclasses.replace(view.updates[-1], effects=sizes)
    text = page(dataclasses.replace(view, updates=(*view.updates[:-1], final)))
    assert "Effect in the model: headwind, 5.743 m/s (5.435 .. 6.047)." in text
    assert "Effect in the model: unbound friction, 90.0 N m (85.0 .. 95.0)." in text
    assert "Effect in the model" not in page(view)


def test_a_value_that_is_withheld_at_the_end_has_no_dot_for_an_answer() -> None:
    view = made_view()
    last = dataclasses.replace(view.final, A=None, c_rr=None, withheld={"A": "too uncertain"})
    text = page(dataclasses.replace(view, updates=(*view.updates[:-1], last)))
    assert text.count('class="dots answer"') == page(view).count('class="dots answer"') - 1 == 2
    assert ">A unestimated<" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "width", "scheme"),
    [
        pytest.param(*opening, marks=() if opening in BY_DAY else pytest.mark.nightly)
        for opening in product(VIEWS, (1280, 400), ("light", "dark"))
    ],
)
def test_the_page_opens_in_a_browser(browser: Any, tmp_path: Path, name: str, width: int, scheme: str) -> None:
    make, plots = VIEWS[name]
    path = tmp_path / "estimate.html"
    write_page(make(), path)
    with opened(browser, path, width, scheme) as tab:
        assert tab.locator(".plot").count() == plots
        for plot in tab.locator(".plot").all():
            box = plot.locator("svg").bounding_box()
            assert box["width"] > 200
            assert box["height"] > 140
            assert plot.locator(".area span").count() >= 4
        # Labels of one axis do not touch each other.
        touching = """[...document.querySelectorAll('.area')].flatMap(a => [...a.querySelectorAll('span.x')]
            .map(s => s.getBoundingClientRect()).filter((r, i, all) => i && r.left < all[i - 1].right)).length"""
        assert tab.evaluate(touching) == 0


@pytest.fixture(scope="module")
def estimated(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The JSON of `estimate` and the page that it wrote, of a drive."""
    folder = tmp_path_factory.mktemp("page")
    log, path = written(drive("mixed", 8, 5), folder / "drive.blf"), folder / "out.html"
    return ask("estimate", log, "--plot", path), path


@pytest.mark.slow
def test_what_is_drawn_is_what_the_json_says(browser: Any, estimated: tuple[dict[str, Any], Path]) -> None:
    answer, path = estimated
    assert answer["status"] == "estimated"
    tab = browser.new_page(viewport={"width": 1280, "height": 900})
    tab.goto(path.as_uri())
    mass = answer["parameters"]["mass_kg"]
    assert numbers(tab.locator("h1").inner_text()) == [round(mass[part]) for part in ("mean", "q05", "q95")]
    for row, plot in zip(ROWS, tab.locator("#time .plot").all(), strict=True):
        x, mean = curve(plot, "line.after")
        updates = [(u["t_s"], u["parameters"][row.key]) for u in answer["updates"] if u["parameters"][row.key]["mean"]]
        newest = updates[-1][1]
        close = 0.02 * (newest["q95"] - newest["q05"])
        assert len(mean) == len(updates)
        assert x == pytest.approx([t for t, _ in updates], abs=5.0)
        assert mean == pytest.approx([y["mean"] for _, y in updates], abs=close)
        _, last = curve(plot, "dots.answer")
        assert last == pytest.approx([answer["parameters"][row.key]["mean"]], abs=close)
        _, edge = curve(plot, "band")
        assert edge[len(updates) - 1] == pytest.approx(newest["q95"], abs=close)
        assert edge[len(updates)] == pytest.approx(newest["q05"], abs=close)
    _, residual = curve(tab.locator(".whole"), "line.residual")
    assert float(np.sqrt(np.mean(residual**2))) == pytest.approx(answer["rms_kW"], rel=0.01)
    stated = tab.locator("#power h3").inner_text()
    assert numbers(stated)[0] == pytest.approx(answer["rms_kW"], abs=0.051)
    cells = {tuple(cell[:2]): cell[2] for cell in answer["coverage_map"]["rows"]}
    assert tab.locator("#coverage .occupied[x]").count() == sum(
        n >= answer["coverage_map"]["needed"] for n in cells.values()
    )
    table = dict(
        zip(
            tab.locator("#answer tbody th").all_inner_texts(),
            tab.locator("#answer tbody td:nth-child(2)").all_inner_texts(),
            strict=True,
        )
    )
    coefficients = answer["coefficients"]
    assert table["c_rr"] == f"{100 * coefficients['c_rr']['mean']:.3f} %"
    assert table["c_d A"] == f"{coefficients['c_d_A_m2']['mean']:.2f} m²"
    assert numbers(table["F0"])[0] == round(answer["parameters"]["A_N"]["mean"])
    assert numbers(table["F2"])[0] == pytest.approx(answer["parameters"]["C_N_s2_m2"]["mean"] / 3.6**2, abs=6e-5)
    tab.close()


@pytest.mark.slow
def test_a_contested_input_leaves_no_curves(estimated: tuple[dict[str, Any], Path]) -> None:
    """The fit behind an estimate that was withheld afterwards is not shown."""
    run = estimate_logs(estimated[1].with_name("drive.blf"), Config())
    evidence = evidence_of(run)
    assert evidence is not None
    assert evidence.rms == run.final.rms
    run.updates.append(dataclasses.replace(run.final, status=Status.UNESTIMATED, reason="contested", mass=None))
    assert evidence_of(run) is None
    assert "Chains" not in page(view_of(run, "drive.blf"))
