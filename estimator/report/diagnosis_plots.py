"""Figures of a diagnosis by matplotlib, of the rows that its page draws."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from estimator.diagnosis.result import Diagnosis
from estimator.report import wording
from estimator.report.notebook_figure import NotebookFigure
from estimator.report.number_format import MINUS
from estimator.report.page.figures import improved

MEASURED, PLAIN, WITH_EFFECTS = "#1b3a4b", "#d1495b", "#2e8b57"
AVERAGED = 15  # rows, 30 s, of the mean line of a residual


def power(d: Diagnosis) -> Figure:
    """Power measured and modelled [kW] over the time of the logs [min]."""
    figure, (axes,) = _figure(1)
    assert d.traces is not None
    t = d.traces.t / 60
    axes.plot(t, d.traces.measured / 1e3, color=MEASURED, lw=0.8, label="measured")
    axes.plot(t, d.traces.base / 1e3, color=PLAIN, lw=0.6, label=wording.base_name(d))
    if better := improved(d, d.traces):
        axes.plot(t, better.power / 1e3, color=WITH_EFFECTS, lw=0.6, label=better.name)
    axes.set_ylabel("power [kW]")
    axes.legend(frameon=False, ncols=3)
    return figure


def gap(d: Diagnosis) -> Figure:
    """Residual [kW] of the model as configured, and with the effects, over the time of the logs [min]."""
    assert d.traces is not None
    curves = [(wording.base_name(d), d.traces.base, PLAIN)]
    if better := improved(d, d.traces):
        curves.append((better.name, better.power, WITH_EFFECTS))
    figure, panels = _figure(len(curves))
    for axes, (name, model, colour) in zip(panels, curves, strict=True):
        residual = (d.traces.measured - model) / 1e3
        rms = 1e3 * float(np.sqrt(np.mean(residual**2)))
        axes.plot(d.traces.t / 60, residual, ".", ms=1, color=colour, alpha=0.4)
        mean = np.convolve(residual, np.full(AVERAGED, 1 / AVERAGED), "same")
        axes.plot(d.traces.t / 60, mean, color=MEASURED, lw=1)
        axes.set_ylabel(f"measured {MINUS} model [kW]")
        axes.set_title(f"{name}: {wording.kilowatts(rms)} rms", loc="left", fontsize="medium")
    return figure


def budget(d: Diagnosis) -> Figure:
    """Shares of the residual's mean square by cause, with 90 % intervals."""
    figure, (axes,) = _figure(1)
    parts = d.budget.parts[::-1] if d.budget is not None else ()
    shares = np.array([100 * part.share for part in parts])
    ends = np.array([[100 * part.q05, 100 * part.q95] for part in parts]).reshape(-1, 2)
    names = [wording.cause(part) for part in parts]
    errors = np.abs(ends.T - shares) if len(parts) else None
    axes.barh(names, shares, xerr=errors, color=WITH_EFFECTS, ecolor=MEASURED)
    axes.set_xlabel("share of the residual [%]")
    return figure


KINDS: dict[str, Callable[[Diagnosis], Figure]] = {"power": power, "gap": gap, "budget": budget}


def _figure(rows: int) -> tuple[Figure, list]:  # type: ignore[type-arg]  # of matplotlib's axes
    figure = NotebookFigure(figsize=(10, 3 * rows + 0.5), layout="tight")
    panels = list(np.atleast_1d(figure.subplots(rows, 1, sharex=True)))
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("time since the first frame [min]")
    return figure, panels
