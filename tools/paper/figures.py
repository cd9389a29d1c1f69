"""The figures, all in one quiet style."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from estimator.estimation.window import ACCELERATION_CELLS, LOWEST_ACCELERATION, SPEED_CELLS
from estimator.road_load import power
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import BURN_IN, GRID, Availability, Drive, Estimate
from paper.experiments import NOISE_LEVELS
from paper.vehicles import DYNO, SI_UNITS

COLOURS = ("#3b6ea5", "#d08a2e", "#4b8b57")
TRUTH = "#333333"
LABELS = ("A", "C", "mass")
WIDTH = 8.0  # inch
CLOSE = np.array([0.93, 1.07])  # of the truth, what the close-up of Fig. 1 shows
STYLE = {
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


def _panels(columns: int, height: float, **options: object) -> tuple[Figure, list[Axes]]:
    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(1, columns, figsize=(WIDTH, height), **options)
    return figure, list(np.atleast_1d(axes))


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
            ax.axhline(DYNO[2] / 1e3, color=TRUTH, lw=0.8, ls="--")
            ax.axvline(BURN_IN, color="#888888", lw=0.8, ls=":")
        column[0].set(title=title, xlim=(0, walk.shape[1]))
        column[0].set_xticks([0, 2500, 5000, 7500])
        column[1].set(xlabel="iteration", xlim=(BURN_IN - 200, BURN_IN + 400), ylim=DYNO[2] / 1e3 * CLOSE)
    for ax in axes[:, 0]:
        ax.set_ylabel("mass [t]")
    _save(figure, path)


def power_trace(drive: Drive, best: Floats, path: Path) -> None:
    """Fig. 2: measured power and the best fit, and what is left."""
    plt.rcParams.update(STYLE)
    figure, (ax, rest) = plt.subplots(2, 1, figsize=(WIDTH, 4.2), sharex=True, height_ratios=(3, 1))
    t = np.arange(len(drive.v))
    fit = power(drive.v, drive.a, best)
    ax.plot(t, drive.P / 1e3, color=COLOURS[1], lw=1.6, label="measured")
    ax.plot(t, fit / 1e3, color=COLOURS[0], lw=0.8, label="best fit")
    ax.set_ylabel("power [kW]")
    ax.legend(ncols=2, loc="upper right")
    rest.plot(t, (drive.P - fit) / 1e3, color="#777777", lw=0.7)
    rest.set(xlabel="time [s]", ylabel="residual [kW]", xlim=(0, len(t)))
    _save(figure, path)


def coverage_map(cycles: list[Cycle], reach: Availability, path: Path) -> None:
    """Fig. 3: available cells grey, occupied ones in colour, one panel a cycle."""
    figure, axes = _panels(len(cycles), 2.9, sharey=True)
    speed = np.arange(SPEED_CELLS + 1) * GRID.speed_step
    acceleration = LOWEST_ACCELERATION + np.arange(ACCELERATION_CELLS + 1) * GRID.acceleration_step
    shape = (SPEED_CELLS, ACCELERATION_CELLS)
    fastest, hardest = (g[reach.cells].max() for g in GRID.centres())
    softest = GRID.centres()[1][reach.cells].min()
    for ax, cycle, colour in zip(axes, cycles, COLOURS, strict=False):
        state = reach.cells.astype(float) + reach.occupied(cycle)
        shown = np.ma.masked_equal(state, 0.0).reshape(shape).T
        colours = mpl.colors.ListedColormap(["#e4e4e4", colour])
        ax.pcolormesh(speed, acceleration, shown, cmap=colours, vmin=1, vmax=2, edgecolors="white", linewidth=0.4)
        ax.set(title=f"{cycle.name}: {100 * reach.coverage(cycle):.0f} %", xlabel="speed [m/s]")
        ax.set(xlim=(0, fastest + GRID.speed_step), ylim=(softest - 0.1, hardest + 0.15))
        ax.grid(visible=False)
    axes[0].set_ylabel("acceleration [m/s²]")
    _save(figure, path)


def coverage_error(coverage: Floats, errors: Floats, path: Path) -> None:
    """Fig. 4: absolute error of every stretch over its coverage, and the median in fifths of them."""
    figure, axes = _panels(3, 2.9, sharey=True)
    order = np.array_split(np.argsort(coverage), 5)
    for i, ax in enumerate(axes):
        error = 100 * np.abs(errors[:, i])
        ax.semilogy(100 * coverage, error, "o", ms=3.5, mew=0, alpha=0.5, color=COLOURS[0])
        medians = [(100 * np.median(coverage[part]), np.median(error[part])) for part in order]
        ax.semilogy(*np.transpose(medians), color=TRUTH, lw=1.3, marker="s", ms=3.5)
        ax.set(title=LABELS[i], xlabel="coverage [%]")
    axes[0].set_ylabel("absolute error [%]")
    _save(figure, path)


def noise_error(errors: dict[str, Floats], path: Path) -> None:
    """Fig. 5: mean error and its sd over the repeats by noise, for two rules of choosing samples."""
    figure, axes = _panels(3, 2.9)
    for i, ax in enumerate(axes):
        ax.axhline(0, color=TRUTH, lw=0.8, ls="--")
        for (rule, e), colour, shift in zip(errors.items(), COLOURS, (0.95, 1.05), strict=False):
            mean, sd = 100 * e[:, :, i].mean(axis=1), 100 * e[:, :, i].std(axis=1, ddof=1)
            level = NOISE_LEVELS * shift / 1e3
            ax.errorbar(level, mean, sd, color=colour, marker="o", ms=3.5, lw=1.1, elinewidth=0.9, label=rule)
        ax.set_xscale("log")
        ax.set_xticks([0.5, 2, 10, 40], ["0.5", "2", "10", "40"])
        ax.minorticks_off()
        ax.set(title=LABELS[i], xlabel="power noise, sd [kW]")
    axes[0].set_ylabel("error, mean ± sd [%]")
    axes[0].legend(loc="upper left", fontsize=8.5)
    _save(figure, path)


def duration_error(results: dict[str, tuple[Floats, Floats]], path: Path) -> None:
    """Fig. 6: median absolute error over the seconds used, one line a cycle."""
    figure, axes = _panels(3, 2.9, sharey=True)
    for i, ax in enumerate(axes):
        for (name, (seconds, errors)), colour in zip(results.items(), COLOURS, strict=False):
            ax.loglog(seconds, 100 * errors[:, i], color=colour, marker="o", ms=3.5, lw=1.2, label=name)
        ax.set_xticks([60, 200, 600, 2000], ["60", "200", "600", "2000"])
        ax.minorticks_off()
        ax.set(title=LABELS[i], xlabel="duration [s]")
    axes[0].set_ylabel("median absolute error [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    _save(figure, path)


def joint_posteriors(estimates: dict[str, Estimate], path: Path) -> None:
    """Appendix: marginals on the diagonal, pairs of parameters below it, the truth dashed."""
    plt.rcParams.update(STYLE)
    figure, axes = plt.subplots(3, 3, figsize=(WIDTH, 7.0))
    scale, units = np.array([1.0, 1.0, 1e-3]), (*SI_UNITS[:2], "t")
    for (_, estimate), colour in zip(estimates.items(), COLOURS, strict=False):
        draws = estimate.draws * scale
        thinned = draws[:: len(draws) // 1500]
        for i in range(3):
            axes[i, i].hist(draws[:, i], bins=60, density=True, color=colour, histtype="stepfilled", alpha=0.55)
            for j in range(i):
                axes[i, j].plot(thinned[:, j], thinned[:, i], ".", ms=2.5, mew=0, alpha=0.35, color=colour)
    for i in range(3):
        axes[i, i].axvline(DYNO[i] * scale[i], color=TRUTH, lw=0.8, ls="--")
        axes[i, i].set(yticks=[])
        axes[i, i].spines["left"].set_visible(False)
        axes[2, i].set_xlabel(f"{LABELS[i]} [{units[i]}]")
        for j in range(3):
            if j < i:
                axes[i, j].axhline(DYNO[i] * scale[i], color=TRUTH, lw=0.8, ls="--")
                axes[i, j].axvline(DYNO[j] * scale[j], color=TRUTH, lw=0.8, ls="--")
                axes[i, j].sharex(axes[j, j])
                axes[i, 0].set_ylabel(f"{LABELS[i]} [{units[i]}]")
            elif j > i:
                axes[i, j].set_axis_off()
    handles = [Line2D([], [], color=c, lw=5, alpha=0.6) for c, _ in zip(COLOURS, estimates, strict=False)]
    axes[0, 2].legend(handles, list(estimates), loc="upper right")
    _save(figure, path)
