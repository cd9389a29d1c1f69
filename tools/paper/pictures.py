"""The figures, in one style."""

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from estimator.estimation.window import CELLS, MIN_ACCELERATION
from estimator.model.road_load import power
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import BURN_IN, GRID, Availability, Drive, Estimate
from paper.hierarchy import HierarchicalFit
from paper.printed import PRINTED
from paper.studies import NOISE_LEVELS, CoverageStudy, DurationStudy, NoiseStudy
from paper.vehicles import DUMMY, HP, NAMES, NOMINAL, PAPER_UNITS, SI_UNITS, TO_SI

COLOURS = ("#3b6ea5", "#d08a2e", "#4b8b57")
TRUTH = "#333333"
LABELS = ("A", "C", "mass")
WIDTH = 8.0  # inch
CLOSE = np.array([0.93, 1.07])  # of the truth, what the close-up of Fig. 1 shows
STYLE: dict[Any, Any] = {
    "figure.dpi": 120,
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def _panels(columns: int, height: float, **options: Any) -> tuple[Figure, list[Axes]]:
    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(1, columns, figsize=(WIDTH, height), **options)
    return figure, list(np.atleast_1d(axes))


def _label(ax: Axes, parameter: int, quantity: str, ticks: tuple[float, ...]) -> None:
    ax.set(title=LABELS[parameter], xlabel=quantity)
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path)
    plt.close(figure)


def random_walk(walks: dict[str, Floats], path: Path) -> None:
    """Fig. 1: mass along chains (chains, iterations, 3), one column a schedule; below, at the end of the burn-in."""
    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(2, len(walks), figsize=(WIDTH, 4.4), sharey="row")
    for column, (title, walk) in zip(axes.T, walks.items(), strict=True):
        for ax in column:
            for chain, colour in zip(walk[:, :, 2] / 1e3, COLOURS, strict=True):
                ax.plot(chain, color=colour, lw=0.7)
            ax.axhline(DUMMY[2] / 1e3, color=TRUTH, lw=0.8, ls="--")
            ax.axvline(BURN_IN, color="#888888", lw=0.8, ls=":")
        column[0].set(title=title, xlim=(0, walk.shape[1]))
        column[0].set_xticks([0, 2500, 5000, 7500])
        column[1].set(xlabel="iteration", xlim=(BURN_IN - 200, BURN_IN + 400), ylim=DUMMY[2] / 1e3 * CLOSE)
    for ax in axes[:, 0]:
        ax.set_ylabel("mass [t]")
    _save(figure, path)


def power_trace(drive: Drive, best: Floats, path: Path) -> None:
    """Fig. 2: measured power, the best fit and the nominal parameters, and the residuals of both."""
    plt.rcParams.update(STYLE)
    figure, (ax, rest) = plt.subplots(2, 1, figsize=(WIDTH, 4.4), sharex=True, height_ratios=(3, 1.4))
    t = np.arange(len(drive.v))
    ax.plot(t, drive.P / HP, color="#bbbbbb", lw=2.2, label="measured")
    for theta, colour, label in ((NOMINAL, COLOURS[1], "nominal"), (best, COLOURS[0], "best fit")):
        model = power(drive.v, drive.a, theta)
        ax.plot(t, model / HP, color=colour, lw=0.8, label=label)
        rest.plot(t, (drive.P - model) / HP, color=colour, lw=0.7)
    ax.set_ylabel("power [hp]")
    ax.legend(ncols=3, loc="upper right")
    rest.set(xlabel="time [s]", ylabel="residual [hp]", xlim=(0, len(t)))
    _save(figure, path)


def coverage_map(cycles: dict[str, Cycle], reach: Availability, path: Path) -> None:
    """Fig. 3: available cells grey, occupied ones in colour, one panel a cycle."""
    figure, axes = _panels(len(cycles), 2.9, sharey=True)
    speed = np.arange(CELLS + 1) * GRID.speed_step
    acceleration = MIN_ACCELERATION + np.arange(CELLS + 1) * GRID.acceleration_step
    shape = (CELLS, CELLS)
    fastest, hardest = (g[reach.cells].max() for g in GRID.centres())
    softest = GRID.centres()[1][reach.cells].min()
    for ax, cycle, colour in zip(axes, cycles.values(), COLOURS, strict=True):
        state = reach.cells.astype(float) + reach.occupied(cycle)
        shown = np.ma.masked_equal(state, 0.0).reshape(shape).T
        colours = mpl.colors.ListedColormap(["#e4e4e4", colour])
        ax.pcolormesh(speed, acceleration, shown, cmap=colours, vmin=1, vmax=2, edgecolors="white", linewidth=0.4)
        ax.set(title=f"{cycle.name}: {100 * reach.coverage(cycle):.0f} %", xlabel="speed [m/s]")
        ax.set(xlim=(0, fastest + GRID.speed_step), ylim=(softest - 0.1, hardest + 0.15))
        ax.grid(visible=False)
    axes[0].set_ylabel("acceleration [m/s²]")
    _save(figure, path)


def coverage_error(studies: dict[str, CoverageStudy], path: Path) -> None:
    """Fig. 4: absolute error of every stretch over its coverage, and the medians of thirds of each cycle."""
    figure, axes = _panels(3, 2.9, sharey=True)
    for (name, study), colour in zip(studies.items(), COLOURS, strict=True):
        thirds = np.array_split(np.argsort(study.coverage), 3)
        for i, ax in enumerate(axes):
            error = 100 * np.abs(study.errors[:, i])
            ax.loglog(100 * study.coverage, error, "o", ms=3.2, mew=0, alpha=0.35, color=colour)
            medians = [(100 * np.median(study.coverage[part]), np.median(error[part])) for part in thirds]
            ax.loglog(*np.transpose(medians), color=colour, lw=1.4, marker="s", ms=4, label=name)
            _label(ax, i, "coverage [%]", (1, 3, 10, 30))
    axes[0].set_ylabel("absolute error [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    _save(figure, path)


def noise_error(studies: dict[str, NoiseStudy], path: Path) -> None:
    """Fig. 5: rms error over the repeats by noise, for two rules of choosing samples, and a line of proportion."""
    figure, axes = _panels(3, 2.9)
    level = NOISE_LEVELS / HP
    for i, ax in enumerate(axes):
        for (rule, study), colour in zip(studies.items(), COLOURS, strict=False):
            ax.loglog(level, 100 * study.rms_errors[:, i], color=colour, marker="o", ms=3.5, lw=1.1, label=rule)
        reference = 100 * next(iter(studies.values())).rms_errors[0, i]
        ax.loglog(level, reference * level / level[0], color=TRUTH, lw=0.8, ls="--", label="in proportion")
        _label(ax, i, "power noise, sd [hp]", (0.5, 2, 10, 40))
    axes[0].set_ylabel("rms error [%]")
    axes[0].legend(loc="upper left", fontsize=8.5)
    _save(figure, path)


def duration_error(studies: dict[str, DurationStudy], path: Path) -> None:
    """Fig. 6: rms error over the seconds used, one line a cycle; a ring marks the whole cycle, copies follow."""
    figure, axes = _panels(3, 2.9, sharey=True)
    for i, ax in enumerate(axes):
        for (name, study), colour in zip(studies.items(), COLOURS, strict=True):
            error = 100 * study.errors[:, i]
            ax.loglog(study.seconds, error, color=colour, marker="o", ms=3, lw=1.2, label=name)
            ax.loglog(study.seconds[study.whole], error[study.whole], "o", ms=8, mfc="none", mec=colour)
        _label(ax, i, "duration [s]", (60, 300, 1500, 7500))
    axes[0].set_ylabel("rms error [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    _save(figure, path)


def hierarchical_fit(posterior: HierarchicalFit, names: list[str], path: Path) -> None:
    """Printed runs (dots), 90 % intervals of their cycle, and of the vehicle; dashed is the nominal value."""
    figure, axes = _panels(3, 2.6, sharey=True)
    for i, ax in enumerate(axes):
        ax.axvline(NOMINAL[i] / TO_SI[i], color=TRUTH, lw=0.8, ls="--")
        for row, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
            runs = PRINTED[name].estimates[:, i]
            ax.plot(runs, np.full(len(runs), row - 0.22), "o", ms=3.5, mew=0, alpha=0.5, color=colour)
            _bar(ax, posterior.theta[:, row, i], row, colour)
        _bar(ax, posterior.mu[:, i], len(names), TRUTH)
        ax.set(title=LABELS[i], xlabel=f"{NAMES[i]} [{PAPER_UNITS[i]}]")
        ax.set_yticks(range(len(names) + 1), [*names, "vehicle"])
    axes[0].invert_yaxis()
    _save(figure, path)


def _bar(ax: Axes, draws: Floats, row: float, colour: str) -> None:
    low, high = np.quantile(draws, [0.05, 0.95])
    ax.plot([low, high], [row, row], color=colour, lw=2.4, solid_capstyle="butt")
    ax.plot(draws.mean(), row, "s", ms=5, color=colour)


def joint_posteriors(estimates: dict[str, Estimate], truth: Floats, path: Path) -> None:
    """Appendix: marginals on the diagonal, pairs of parameters below it, the truth dashed."""
    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(3, 3, figsize=(WIDTH, 7.0))
    scale, units = np.array([1.0, 1.0, 1e-3]), (*SI_UNITS[:2], "t")
    for estimate, colour in zip(estimates.values(), COLOURS, strict=True):
        draws = estimate.draws * scale
        thinned = draws[:: len(draws) // 1500]
        for i in range(3):
            axes[i, i].hist(draws[:, i], bins=60, density=True, color=colour, histtype="stepfilled", alpha=0.55)
            for j in range(i):
                axes[i, j].plot(thinned[:, j], thinned[:, i], ".", ms=2.5, mew=0, alpha=0.35, color=colour)
    for i in range(3):
        axes[i, i].axvline(truth[i] * scale[i], color=TRUTH, lw=0.8, ls="--")
        axes[i, i].set(yticks=[])
        axes[i, i].spines["left"].set_visible(False)
        axes[2, i].set_xlabel(f"{LABELS[i]} [{units[i]}]")
        for j in range(3):
            if j < i:
                axes[i, j].axhline(truth[i] * scale[i], color=TRUTH, lw=0.8, ls="--")
                axes[i, j].axvline(truth[j] * scale[j], color=TRUTH, lw=0.8, ls="--")
                axes[i, j].sharex(axes[j, j])
                axes[i, 0].set_ylabel(f"{LABELS[i]} [{units[i]}]")
            elif j > i:
                axes[i, j].set_axis_off()
    handles = [Line2D([], [], color=c, lw=5, alpha=0.6) for c, _ in zip(COLOURS, estimates, strict=True)]
    axes[0, 2].legend(handles, list(estimates), loc="upper right")
    _save(figure, path)
