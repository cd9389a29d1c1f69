"""Draw the pictures of the README from its own drives, into docs/pictures: ``python tools/pictures.py``.

``mass.svg`` is the mass of the demonstration narrowing to its answer, ``gap.svg`` the residual of the drive in hills
before and after its effect is in the model.
"""

import contextlib
import sys
import tempfile
from io import StringIO
from pathlib import Path

import matplotlib as mpl
import numpy as np
import readme
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estimator import diagnose, read
from estimator.commands import demo
from estimator.commands.main import main as program
from estimator.config import Config
from estimator.report import wording
from estimator.report.estimate_view import Curve, EstimateView, view_of
from estimator.report.number_format import MINUS
from estimator.report.page.figures import improved
from estimator.report.page.plot import axis
from estimator.report.page.series import BLOCKS, binned
from estimator.report.parameter_text import ROWS
from estimator.report.plots import FADED, INK, MARK
from estimator.streaming.replay import estimate_logs

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "pictures"
MASS = ROWS[0]


def mass(view: EstimateView) -> Figure:
    """Mean and 90 % interval of the mass at every update, and the truth."""
    curve: Curve = view.curve(MASS)
    figure = Figure(figsize=(7.5, 2.6), layout="tight")
    axes = figure.subplots()
    axes.fill_between(curve.t / 60, curve.low, curve.high, color=FADED, alpha=0.5, lw=0, label="90 % interval")
    axes.plot(curve.t / 60, curve.mean, color=INK, lw=1.5, label="mean")
    axes.axhline(demo.TRUCK.mass, color=MARK, lw=1, ls="--", label=f"truth {MASS.value(demo.TRUCK.mass)}")
    axes.set_title(f"mass {view.headline}", loc="left", color=INK)
    axes.set_xlabel("driving time [min]")
    axes.set_ylabel("kg")
    axes.set_xlim(0, curve.t[-1] / 60)
    axes.legend(frameon=False, ncols=3, fontsize="small", loc="lower right")
    _quiet(axes)
    return figure


def gap(log: Path) -> Figure:
    """Residual of the plain model and with its effect, as means in bins; the titles have the rms of all."""
    found = diagnose(read(log))
    assert found.traces is not None
    traces, better = found.traces, improved(found, found.traces)
    assert better is not None
    curves = [("plain model", traces.base), (f"with {found.effects[0].name}", better.power)]
    figure = Figure(figsize=(7.5, 3.4), layout="tight")
    panels = figure.subplots(len(curves), 1, sharex=True, sharey=True)
    x = axis(traces.t.tolist(), "")
    for panel, (name, model), colour in zip(panels, curves, (MARK, INK), strict=True):
        residual = (traces.measured - model) / 1e3
        at, _, _, means = binned(x, traces.t, residual, BLOCKS)
        panel.plot(at / 60, means, color=colour, lw=1.2)
        rms = wording.kilowatts(1e3 * float(np.sqrt(np.mean(residual**2))))
        panel.set_title(f"{name}: {rms}", loc="left", color=INK)
        _quiet(panel)
    panels[-1].set_xlabel("driving time [min]")
    figure.supylabel(f"measured {MINUS} model [kW]", fontsize="medium", color=INK)
    return figure


def _quiet(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small", colors=INK)


def drawn(folder: Path) -> dict[str, Figure]:
    """The pictures by name; the logs are made in ``folder``."""
    drive, hills = folder / "drive.blf", folder / "out" / "hills.blf"
    hills.parent.mkdir()
    with contextlib.chdir(folder), contextlib.redirect_stdout(StringIO()):
        program(["demo", "-o", str(drive)])
        words = next(words for words in readme.commands(readme.README.read_text()) if "out/hills.blf" in words)
        program(words)
    return {"mass": mass(view_of(estimate_logs([drive], Config()), "")), "gap": gap(hills)}


def main() -> int:
    """Write the files."""
    mpl.rcParams["svg.fonttype"], mpl.rcParams["path.simplify"] = "none", False  # numbers as text, every point
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, figure in drawn(Path(folder)).items():
            figure.savefig(FOLDER / f"{name}.svg", format="svg", metadata={"Date": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
