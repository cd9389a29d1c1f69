"""An estimate as one picture: the answer, how it formed, coverage, power with its residual, joint posterior, chains."""

from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from estimator.output_files import check_suffix, whole
from estimator.printable import printable
from estimator.report import parameter_text, summary, wanted_driving
from estimator.report.effect_sizes import effect_size
from estimator.report.estimate_view import EstimateView, PowerTrace
from estimator.report.notebook_figure import NotebookFigure
from estimator.report.number_format import MINUS
from estimator.report.page.plot import ClockAxis
from estimator.report.parameter_text import ROWS, Row
from estimator.report.wanted_driving import BEGUN, OCCUPIED, WANTED
from estimator.report.wording import label
from estimator.units import KMH

INK, FADED, MARK = "#1b3a4b", "#8fa9b8", "#d1495b"
COLOURS = {OCCUPIED: ("occupied", INK), BEGUN: ("begun", FADED), WANTED: ("wanted", "#f6ead0")}
FORMATS = (".png", ".svg", ".pdf")
mpl.rcParams["svg.hashsalt"] = "roadload"


class Clock(NamedTuple):
    """Times [s] from ``low`` to ``high`` on the abscissa of a panel."""

    low: float
    high: float

    def on(self, axes: Axes) -> None:
        """Mark the abscissa with round times."""
        axis = ClockAxis(self.low, self.high, "")
        axes.set_xlim(self.low, self.high)
        axes.set_xticks(axis.ticks(6))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: axis.text(value)))


def write_plot(view: EstimateView, path: Path) -> None:
    """Draw an estimate and what it rests on.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    figure = draw(view)
    kind = path.suffix.lower().removeprefix(".")
    image = BytesIO()
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)  # the same picture is the same file
    figure.savefig(image, format=kind, dpi=130, metadata=undated)
    with whole(path) as file:
        file.write(image.getvalue())


def draw(view: EstimateView) -> Figure:
    """The whole figure; without evidence, what was driven and how the estimate formed."""
    # The solver of the layout "constrained" goes by the addresses of its variables, so its last bits are not the same
    # in two drawings.
    heights = [1.0, 1.0, 0.6, 1.1, 0.8] if view.evidence is not None else [1.0, 1.0]
    figure = NotebookFigure(figsize=(11, 3 * sum(heights) + 0.8), layout="tight")
    FigureCanvasAgg(figure)
    figure.suptitle(_title(view), color=INK, parse_math=False)  # names of files may have dollar signs
    grid = GridSpec(len(heights), 3, figure=figure, height_ratios=heights)
    for i, row in enumerate(ROWS):
        _formed(figure.add_subplot(grid[0, i]), view, row)
    _coverage(figure.add_subplot(grid[1, 0]), view)
    power = view.power
    if power is None:
        return figure
    _power(figure.add_subplot(grid[1, 1:]), power.telling)
    _residual(figure.add_subplot(grid[2, :]), power, view.final.rms)
    for i, (across, up) in enumerate(combinations(ROWS, 2)):
        if across in view.rows and up in view.rows:
            _joint(figure.add_subplot(grid[3, i]), view, across, up)
    for i, row in enumerate(ROWS):
        if row in view.rows:
            _chains(figure.add_subplot(grid[4, i]), view, row)
    return figure


def _title(view: EstimateView) -> str:
    """The logs and the answer, the mass in a line of its own, what is withheld, and the effects in the model."""
    final = view.final
    name = printable(" · ".join(part for part in (view.title, view.date) if part))
    known = parameter_text.known(summary.parameters(final), summary.coefficients(final))
    values = [f"{x.row.name} {x.row.value(x.mean)} ({x.row.interval(x.q05, x.q95)})" for x in known]
    mass, others = (values[0], ", ".join(values[1:])) if values else (printable(view.headline), "")
    unknown = ", ".join(f"{name} unestimated" for name in final.withheld)
    effects = ", ".join(f"{label(name)} {effect_size(name, size)}" for name, size in final.effects.items())
    lines = (name, mass, ", ".join(filter(None, (others, unknown))), f"with {effects}" if effects else "")
    return "\n".join(line for line in lines if line)


def _formed(axes: Axes, view: EstimateView, row: Row) -> None:
    curve = view.curve(row)
    axes.fill_between(curve.t, curve.low, curve.high, color=FADED, alpha=0.5, lw=0)
    axes.plot(curve.t, curve.mean, color=INK, lw=1.2)
    axes.plot(curve.t[curve.answer], curve.mean[curve.answer], "o", color=MARK, ms=5)
    if np.isfinite(curve.mean).any():
        low, high = curve.range
        axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
    Clock(0.0, 1.02 * max(float(curve.t[-1]), 1.0)).on(axes)
    axes.set_xlabel("time since the first frame")
    axes.set_title(f"{row.name} [{row.unit}]", fontsize="medium", color=INK)
    _quiet(axes)


def _coverage(axes: Axes, view: EstimateView) -> None:
    cells = view.cells
    dv, da, lowest = KMH * cells.speed_step_m_s, cells.acceleration_step_m_s2, cells.lowest_acceleration_m_s2
    states = wanted_driving.cell_states(cells)
    for (i, j), state in states.items():
        axes.bar(i * dv, da, dv, lowest + j * da, align="edge", color=COLOURS[state][1], edgecolor="white", lw=0.5)
    if states:
        keys = [Patch(color=colour, label=name) for name, colour in COLOURS.values()]
        axes.legend(
            handles=keys, frameon=False, ncols=3, fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, 1.13)
        )
    axes.set_xlabel("speed [km/h]")
    axes.set_ylabel("acceleration [m/s²]")
    _quiet(axes)


def _power(axes: Axes, part: PowerTrace) -> None:
    axes.plot(part.t, part.measured, color=FADED, lw=2.5, label="measured")
    axes.plot(part.t, part.fitted, color=MARK, lw=0.9, label="fitted")
    Clock(float(np.nanmin(part.t)), float(np.nanmax(part.t))).on(axes)
    axes.set_ylabel("power [kW]")
    axes.set_title("the minutes in which the fit misses most", fontsize="medium", color=INK)
    axes.legend(frameon=False, ncols=2, loc="upper right", fontsize="small")
    _quiet(axes)


def _residual(axes: Axes, power: PowerTrace, rms: float | None) -> None:
    axes.plot(power.t, power.residual, color=INK, lw=0.5)
    axes.axhline(0, color=FADED, lw=0.8)
    Clock(float(np.nanmin(power.t)), float(np.nanmax(power.t))).on(axes)
    axes.set_xlabel("time since the first frame")
    axes.set_ylabel(f"measured {MINUS} fitted [kW]")
    stated = "" if rms is None else f", root mean square {rms / 1e3:.1f} kW"
    axes.set_title(f"residual{stated}", fontsize="medium", color=INK)
    _quiet(axes)


def _joint(axes: Axes, view: EstimateView, across: Row, up: Row) -> None:
    axes.plot(view.draws(across), view.draws(up), ".", ms=2, color=INK, alpha=0.3, rasterized=True)
    for q in np.quantile(view.chains(across), [0.05, 0.95]):
        axes.axvline(q, color=MARK, lw=1)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel(f"{across.name} [{across.unit}]")
    axes.set_ylabel(f"{up.name} [{up.unit}]")
    _quiet(axes)


def _chains(axes: Axes, view: EstimateView, row: Row) -> None:
    axes.plot(view.chains(row)[:4].T, lw=0.5, alpha=0.8)
    axes.set_xlabel("draw, first 4 chains")
    axes.set_ylabel(f"{row.name} [{row.unit}]")
    _quiet(axes)


def _quiet(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small", colors=INK)
