"""The figures of the page: gap map, residual in time and along the road, power, bars of the residual."""

import html
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.components.budget import NOISE, Budget
from estimator.diagnosis.result import Diagnosis, GapMap, Span, Traces
from estimator.report import wording
from estimator.report.number_format import MINUS, clock
from estimator.report.page.plot import CLOCK, Axis, axis, band, bar, cell, clock_axis, line, plot
from estimator.report.page.series import BLOCKS, binned, telling_minutes
from estimator.signals import Floats
from estimator.units import KMH

CAUSES = 8  # colours of the budget; further causes share the last
BINS = 600  # of an overview: each shows its least, greatest and, in blocks, its mean residual
MAX_BREAK = 900.0  # s; longer ones, as between two logs, are cut out of the overview
CUT_BREAK = 60.0  # s, their length after the cut


class Improved(NamedTuple):
    """The better model that is drawn beside the plain one: its ``name`` and its ``power`` [W] (n,)."""

    name: str
    power: Floats


def improved(d: Diagnosis, traces: Traces) -> Improved | None:
    """The model that the headline is of: with all that was found, or with a road that no signal shows; None if none."""
    if not d.effects:
        return None
    if known := wording.road_known(d):
        return Improved(known[0], traces.road_known)
    return Improved("with the effects", traces.extended)


def gap_map(cells: GapMap, base: str, better: Improved | None) -> str:
    """Mean residual by speed and acceleration on one scale, of the model named ``base`` and of a better one."""
    shown = [(base, cells.plain)] + ([(better.name, cells.extended)] if better else [])
    scale = _scale(np.concatenate([values.ravel() for _, values in shown]) / 1e3)
    seen = np.isfinite(cells.plain) | np.isfinite(cells.extended)
    x = _covered(KMH * cells.speed_edges, np.flatnonzero(seen.any(axis=1)), "speed [km/h]")
    y = _covered(cells.acceleration_edges, np.flatnonzero(seen.any(axis=0)), "acceleration [m/s²]")
    maps = "".join(
        plot(_cells(cells, values / 1e3, x, y, scale), x, y, _map_words(name, values), name, "map")
        for name, values in shown
    )
    legend = f'<p class="scale"><span>{MINUS}{scale:g} kW</span><i></i><span>+{scale:g} kW</span></p>'
    return f'<div class="pair">{maps}</div>{legend}'


def _cells(cells: GapMap, kilowatts: Floats, x: Axis, y: Axis, scale: float) -> str:
    v, a = (KMH * cells.speed_edges).tolist(), cells.acceleration_edges.tolist()
    shapes = []
    for i, j in np.argwhere(np.isfinite(kilowatts)).tolist():
        value, count = float(kilowatts[i, j]), float(cells.samples[i, j])
        words = (
            f"{v[i]:g} to {v[i + 1]:g} km/h, {a[j]:.2g} to {a[j + 1]:.2g} m/s²: {value:+.1f} kW, {count:,.0f} samples"
        )
        strength = 0.04 + 0.96 * min(abs(value) / scale, 1)
        shapes.append(cell(x, y, (v[i], v[i + 1], a[j], a[j + 1]), "high" if value > 0 else "low", strength, words))
    return "".join(shapes)


def _map_words(name: str, values: Floats) -> str:
    finite = values[np.isfinite(values)] / 1e3
    if not len(finite):
        return f"Gap map, {name}: no cell has enough data"
    return f"Gap map, {name}: mean residual from {finite.min():.1f} to {finite.max():.1f} kW over {len(finite)} cells"


def _covered(edges: Floats, seen: NDArray[np.intp], label: str) -> Axis:
    kept = edges[seen[0] : seen[-1] + 2] if len(seen) else edges
    return axis(kept.tolist(), label)


def in_time(traces: Traces, d: Diagnosis, better: Improved | None) -> str:
    """Residual over the drive, before and after, with the times in which effects act."""
    running = _running(traces)
    acting = [span for effect in d.effects for span in effect.span]
    spans = np.array([_placed(span, traces, running) for span in acting]).reshape(-1, 2)
    cut = running[-1] < (traces.t[-1] - traces.t[0]) - 1
    label = "driving time [h:mm], long breaks left out" if cut else CLOCK
    if _has_several_logs(traces):
        label = "driving time [h:mm], log after log"
    x = clock_axis(running, label)
    note = '<p class="soft">Shaded: when an effect acts.</p>' if len(spans) else ""
    return note + _residuals(running, traces, d, better, x, spans) + _speed(running, traces, x)


def along_the_road(traces: Traces, d: Diagnosis, better: Improved | None) -> str:
    """Residual over the distance driven, before and after."""
    # Each drive counts from zero: they are laid end to end.
    steps = np.maximum(np.diff(traces.distance, prepend=traces.distance[:1]), 0.0)
    distance = float(traces.distance[0]) + np.cumsum(steps)
    x = axis((distance / 1e3).tolist(), "distance [km]")
    return _residuals(distance / 1e3, traces, d, better, x, np.empty((0, 2)))


def _has_several_logs(traces: Traces) -> bool:
    return bool(traces.log[0] != traces.log[-1])


def _running(traces: Traces) -> Floats:
    """Ascending time [s] (n,): long breaks, and those between two logs, become CUT_BREAK."""
    steps = np.diff(traces.t, prepend=traces.t[:1])
    steps[(steps > MAX_BREAK) | (steps < 0) | (np.diff(traces.log, prepend=traces.log[:1]) > 0)] = CUT_BREAK
    running: Floats = float(traces.t[0]) + np.cumsum(steps)
    return running


def _placed(span: Span, traces: Traces, running: Floats) -> Floats:
    """Start and end [s] (2,) of a span on the ``running`` time of the figures."""
    own = traces.log == span.log
    order = np.argsort(traces.t[own])
    placed: Floats = np.interp([span.start, span.end], traces.t[own][order], running[own][order])
    return placed


def _residuals(position: Floats, traces: Traces, d: Diagnosis, better: Improved | None, x: Axis, spans: Floats) -> str:
    residuals = [(wording.base_name(d), "before", (traces.measured - traces.base) / 1e3)]
    if better:
        residuals.append((better.name, "after", (traces.measured - better.power) / 1e3))
    bins = [(name, kind, binned(x, position, r, BINS), binned(x, position, r, BLOCKS)) for name, kind, r in residuals]
    y = axis(
        np.nanpercentile(residuals[0][2], [0.5, 99.5]).tolist(), f"measured {MINUS} model [kW]", zero=True, margin=0.1
    )
    marks = "".join(bar(x, start, end, "span") for start, end in spans.tolist())
    panels = []
    for name, kind, (at, low, high, _), (centre, _, _, mean) in bins:
        shapes = marks + band(x, y, at, low, high, f"band {kind}") + line(x, y, centre, mean, f"line {kind}")
        words = f"Residual, {name}, over {x.label}: block means from {np.nanmin(mean):.1f} to {np.nanmax(mean):.1f} kW"
        panels.append(plot(shapes, x, y, words, name, "strip"))
    return "".join(panels)


def _speed(position: Floats, traces: Traces, x: Axis) -> str:
    """Speed over the same axis as the residuals."""
    speed = KMH * traces.speed
    y = axis(speed.tolist(), "km/h", zero=True, margin=0.1)
    centre, _, _, mean = binned(x, position, speed, BLOCKS)
    words = f"Speed over {x.label}: block means up to {np.nanmax(mean):.0f} km/h"
    return plot(line(x, y, centre, mean, "line measured"), x, y, words, "speed", "strip")


def power(traces: Traces, base: str, better: Improved | None) -> str:
    """Measured power and that of the models in the five most informative minutes, from that of ``base`` on."""
    squared = (traces.measured - traces.base) ** 2
    worth = np.nan_to_num(squared - (traces.measured - better.power) ** 2 if better else squared)
    running = _running(traces)
    window = telling_minutes(running, worth, running[np.searchsorted(traces.log, traces.log, side="right") - 1])
    t = traces.t[window]
    late = np.diff(t, prepend=t[:1]) > 5 * np.median(np.diff(running))  # no line across a stop
    log = f" of log {traces.log[window.start] + 1:.0f}" if _has_several_logs(traces) else ""
    x = clock_axis(t, f"time since the first frame{log} [h:mm]")
    curves = [("measured", traces.measured), ("before", traces.base)] + ([("after", better.power)] if better else [])
    values = {kind: np.where(late, np.nan, curve[window] / 1e3) for kind, curve in curves}
    y = axis(np.concatenate(list(values.values())).tolist(), "power [kW]", zero=True, margin=0.04)
    shapes = "".join(line(x, y, t, v, f"line {kind}") for kind, v in values.items())
    names = {"measured": "measured", "before": base, "after": better.name if better else ""}
    key = "".join(f'<span class="{kind}">{names[kind]}</span>' for kind in values)
    words = f"Power from {clock(x.low)} to {clock(x.high)}: " + ", ".join(names[k] for k in values)
    return f'<p class="key">{key}</p>' + plot(shapes, x, y, words, kind="trace")


def bars(d: Diagnosis) -> str:
    """The residual from the model as configured down to the noise floor, one bar an effect.

    What a known road would leave has a list of its own: other effects are not in it, so it is no further step.
    """
    steps = [(name, rms) for name, rms in wording.ladder(d) if math.isfinite(rms)]
    exact, known = wording.if_road_were_exact(d), wording.road_known(d)
    steps += [] if exact is None else [("if its road were exact", exact)]
    apart = [] if known is None else [(f"{wording.base_name(d)} {known[0]}", known[1])]
    floor = d.noise_floor if d.noise_floor is not None and math.isfinite(d.noise_floor) else 0.0
    greatest = max([floor, *(rms for _, rms in steps + apart)], default=0.0)
    if not greatest > 0:
        return ""
    kinds = ["before", *("after" for _ in steps[1:])]
    lines = [_bar(name, rms, floor, greatest, kind) for (name, rms), kind in zip(steps, kinds, strict=True)]
    lines += [_bar("noise floor", floor, floor, greatest, "after")] if floor else []
    drawn = f'<ul class="bars" aria-label="Residual, root mean square, step by step">{"".join(lines)}</ul>'
    if not apart:
        return drawn
    other = "".join(_bar(name, rms, floor, greatest, "after") for name, rms in apart)
    return (
        f'{drawn}<p class="soft">For comparison, no further step:</p>'
        f'<ul class="bars" aria-label="Residual, root mean square, no further step">{other}</ul>'
    )


def _bar(name: str, rms: float, floor: float, greatest: float, kind: str) -> str:
    """One entry: grey up to the noise ``floor`` [W], and the colour of its ``kind`` above it."""
    noise, gap = min(rms, floor) / greatest, max(rms - floor, 0) / greatest
    coloured = f'<i class="{kind}" style="width:{gap:.1%}"></i>' if rms > floor else ""
    return (
        f'<li><span>{html.escape(name)}</span><b class="bar"><i class="noise" style="width:{noise:.1%}"></i>'
        f"{coloured}</b><span>{wording.kilowatts(rms)}</span></li>"
    )


def budget(whole: Budget) -> str:
    """The gap as one bar, a colour a cause, with its legend; causes that take nothing away have no width."""
    total = sum(max(part.share, 0.0) for part in whole.parts)
    if not total > 0:
        return ""
    blocks, legend = [], []
    for i, part in enumerate(whole.parts):
        colour = "noise" if part.cause == NOISE else f"cause-{min(i, CAUSES - 1)}"
        blocks.append(f'<i class="{colour}" style="width:{max(part.share, 0.0) / total:.1%}"></i>')
        share = html.escape(wording.percent(part.share))
        legend.append(f'<li><b class="{colour}"></b>{html.escape(wording.cause(part))} <span>{share}</span></li>')
    return f'<b class="bar budget">{"".join(blocks)}</b><ul class="legend">{"".join(legend)}</ul>'


def _scale(kilowatts: Floats) -> float:
    """A round value that few cells exceed."""
    finite = np.abs(kilowatts[np.isfinite(kilowatts)])
    wanted = max(float(np.percentile(finite, 95)) if len(finite) else 1.0, 0.1)
    power = 10.0 ** math.floor(math.log10(wanted))
    return next(power * s for s in (1.0, 2.0, 5.0, 10.0) if power * s >= wanted)
