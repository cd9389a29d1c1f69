"""One picture of an estimate: joint posterior, power measured and fitted, coverage, chains."""

import base64
import html
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import MaxNLocator

from estimator.estimation.evidence import Evidence
from estimator.estimation.window import ACCELERATION_CELLS, MIN_ACCELERATION, SPEED_CELLS
from estimator.output_files import check_suffix, whole
from estimator.printable import printable

NAMES = ("A [N]", "C [N s²/m²]", "m [kg]")
INK, FADED, MARK = "#1b3a4b", "#8fa9b8", "#d1495b"
SHOWN = 600.0  # s of the power trace
FORMATS = (".png", ".svg", ".pdf", ".html")
mpl.rcParams["svg.hashsalt"] = "roadload"


def write_plot(evidence: Evidence, title: str, path: Path) -> None:
    """Draw what an estimate rests on; ``.html`` is one page that opens offline.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    check_suffix(path, FORMATS)
    title = printable(title)
    figure = draw(evidence, title)
    kind = path.suffix.lower().removeprefix(".")
    image = BytesIO()
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)  # the same picture is the same file
    figure.savefig(image, format="png" if kind == "html" else kind, dpi=130, metadata=undated)
    content = image.getvalue()
    if kind == "html":
        content = _page(title, content).encode()
    with whole(path) as file:
        file.write(content)


def draw(evidence: Evidence, title: str) -> Figure:
    """The whole figure."""
    # The solver of the layout "constrained" goes by the addresses of its variables, so its last bits are not the same
    # in two drawings.
    figure = Figure(figsize=(11, 10), layout="tight")
    FigureCanvasAgg(figure)
    figure.suptitle(title, color=INK, parse_math=False)  # names of files may have dollar signs
    grid = GridSpec(5, 3, figure=figure, height_ratios=[1, 1, 1, 0.9, 0.9])
    _corner(figure, grid, evidence)
    _power_trace(figure.add_subplot(grid[3, :2]), evidence)
    _coverage(figure.add_subplot(grid[3, 2]), evidence)
    for i in range(3):
        _chains(figure.add_subplot(grid[4, i]), evidence, i)
    return figure


def _corner(figure: Figure, grid: GridSpec, evidence: Evidence) -> None:
    draws = evidence.posterior.draws.reshape(-1, evidence.posterior.draws.shape[2])
    for row in range(3):
        for column in range(row + 1):
            axes = figure.add_subplot(grid[row, column])
            if row == column:
                axes.hist(draws[:, row], bins=40, color=FADED)
                for q in np.quantile(draws[:, row], [0.05, 0.95]):
                    axes.axvline(q, color=MARK, lw=1)
                axes.set_yticks([])
            else:
                axes.plot(draws[:, column], draws[:, row], ".", ms=1, color=INK, alpha=0.3, rasterized=True)
            axes.set_xlabel(NAMES[column]) if row == 2 or row == column else axes.set_xticklabels([])
            axes.xaxis.set_major_locator(MaxNLocator(4))
            if column == 0 and row > 0:
                axes.set_ylabel(NAMES[row])
            _quiet(axes)


def _power_trace(axes: Axes, evidence: Evidence) -> None:
    trace = evidence.trace
    shown = slice(-round(SHOWN / trace.spacing), None)
    position = np.arange(len(trace.P[shown])) * trace.spacing
    axes.plot(position, trace.P[shown] / 1e3, color=FADED, lw=0.8, label="measured")
    axes.plot(position, trace.fitted[shown] / 1e3, color=MARK, lw=0.6, label="best fit")
    axes.set_xlabel("used samples, the last ones [s]")
    axes.set_ylabel("power [kW]")
    axes.legend(frameon=False, ncols=2, loc="upper right", fontsize="small")
    _quiet(axes)


def _coverage(axes: Axes, evidence: Evidence) -> None:
    counts = evidence.counts.reshape(SPEED_CELLS, ACCELERATION_CELLS).astype(float)
    counts[counts == 0] = np.nan
    rows, columns = np.flatnonzero(np.isfinite(counts).any(axis=1)), np.flatnonzero(np.isfinite(counts).any(axis=0))
    top, low, high = rows[-1] + 1, columns[0], columns[-1] + 1
    extent = (
        0.0,
        top * evidence.grid.speed_step,
        MIN_ACCELERATION + low * evidence.grid.acceleration_step,
        MIN_ACCELERATION + high * evidence.grid.acceleration_step,
    )
    shown = np.log10(counts[:top, low:high].T)
    image = axes.imshow(shown, origin="lower", aspect="auto", extent=extent, cmap="Blues", vmin=0)
    bar = axes.figure.colorbar(image, ax=axes)
    bar.set_label("log10 samples")
    axes.set_xlabel("speed [m/s]")
    axes.set_ylabel("acceleration [m/s²]")
    _quiet(axes)


def _chains(axes: Axes, evidence: Evidence, i: int) -> None:
    axes.plot(evidence.posterior.draws[:8, :, i].T, lw=0.5, alpha=0.8)
    axes.set_xlabel("draw, first 8 chains")
    axes.set_ylabel(NAMES[i])
    _quiet(axes)


def _quiet(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small", colors=INK)


def _page(title: str, picture: bytes) -> str:
    encoded = base64.b64encode(picture).decode()
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>body{{margin:1rem auto;max-width:70rem;font:1rem sans-serif}}"
        f'img{{width:100%}}</style><img alt="{html.escape(title)}" src="data:image/png;base64,{encoded}"></html>\n'
    )
