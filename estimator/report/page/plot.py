"""Plots that fit any width: shapes in an inline SVG that stretches, labels in HTML that keep their size.

Positions inside the drawing run from 0 to `SIDE` both ways; strokes do not scale (see the style sheet). Colours come
from classes, so that they follow the reader's light or dark scheme.
"""

import html
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from estimator.report.number_format import MINUS
from estimator.signals import Floats, Mask

SIDE = 1000  # units of the drawing, each way
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)  # of a tick, times a power of ten


@dataclass(frozen=True, slots=True)
class Axis:
    """A linear axis with round ticks."""

    low: float
    high: float
    label: str

    def at(self, values: Floats) -> Floats:
        """Positions (n,) of ``values`` (n,) in the drawing, 0 at the low end."""
        return SIDE * (values - self.low) / (self.high - self.low)

    def ticks(self, most: int) -> Floats:
        """At most ``most`` round values (k,) inside the axis."""
        rough = (self.high - self.low) / most
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * s for s in STEPS if power * s >= rough * (1 - 1e-9))
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return np.arange(first, last + 1) * step


def axis(values: Iterable[float], label: str, *, zero: bool = False, margin: float = 0.0) -> Axis:
    """An axis over the finite ones of ``values``, with ``zero`` inside and a margin as a share of the range."""
    finite = [v for v in values if math.isfinite(v)] + ([0.0] if zero else [])
    low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
    if not high - low > 1e-9 * max(abs(low), abs(high)):
        low, high = low - 0.5, high + 0.5
    room = margin * (high - low)
    return Axis(low - room, high + room, label)


def line(x: Axis, y: Axis, xs: Floats, ys: Floats, kind: str) -> str:
    """A line through ``xs``, ``ys`` (n,) of CSS class ``kind``, broken where either is NaN."""
    return f'<path class="{kind}" d="{_path(x.at(xs), SIDE - y.at(ys))}"/>'


def band(x: Axis, y: Axis, xs: Floats, low: Floats, high: Floats, kind: str) -> str:
    """The area between the lines ``low`` and ``high`` over ``xs``, all (n,), broken where they are NaN."""
    px, top, bottom = x.at(xs), SIDE - y.at(high), SIDE - y.at(low)
    areas = []
    for run in _runs(np.isfinite(px) & np.isfinite(top) & np.isfinite(bottom)):
        outline_x = np.concatenate([px[run], px[run][::-1]])
        outline_y = np.concatenate([top[run], bottom[run][::-1]])
        areas.append(_path(outline_x, outline_y) + "Z")
    return f'<path class="{kind}" d="{"".join(areas)}"/>'


def bar(x: Axis, start: float, end: float, kind: str) -> str:
    """A vertical bar over the whole height, e.g. the time in which an effect acts; nothing outside the axis."""
    left, right = (min(max(v, 0.0), SIDE) for v in x.at(np.array([start, end])).tolist())
    return f'<rect class="{kind}" x="{left:.1f}" y="0" width="{max(right - left, 1):.1f}" height="{SIDE}"/>'


def cell(x: Axis, y: Axis, corners: tuple[float, float, float, float], kind: str, strength: float, text: str) -> str:
    """One cell (x from, to, y from, to) of a map, as opaque as ``strength``, with the text shown on hovering."""
    left, right = x.at(np.array(corners[:2])).tolist()
    bottom, top = y.at(np.array(corners[2:])).tolist()
    return (
        f'<rect class="cell {kind}" x="{left:.1f}" y="{SIDE - top:.1f}" width="{right - left:.1f}" '
        f'height="{top - bottom:.1f}" fill-opacity="{strength:.2f}"><title>{html.escape(text)}</title></rect>'
    )


def plot(shapes: str, x: Axis, y: Axis, description: str, title: str = "", kind: str = "") -> str:
    """The drawing with its axes; ``description`` is its text for screen readers."""
    grid, labels = [], []
    for value, at in _placed(x, 8):
        grid.append(f'<path class="grid" d="M{at:.1f} 0V{SIDE}"/>')
        labels.append(f'<span class="x" style="left:{at / SIDE:.2%}">{_tick(value)}</span>')
    for value, at in _placed(y, 5):
        rule = "zero" if value == 0 else "grid"
        grid.append(f'<path class="{rule}" d="M0 {SIDE - at:.1f}H{SIDE}"/>')
        labels.append(f'<span class="y" style="bottom:{at / SIDE:.2%}">{_tick(value)}</span>')
    heading = f'<p class="panel">{html.escape(title)}</p>' if title else ""
    return (
        f'<div class="plot {kind}">{heading}<p class="unit">{html.escape(y.label)}</p>'
        f'<div class="area" role="img" aria-label="{html.escape(description)}">'
        f'<svg viewBox="0 0 {SIDE} {SIDE}" preserveAspectRatio="none" aria-hidden="true">{"".join(grid)}{shapes}</svg>'
        f"{''.join(labels)}</div>"
        f'<p class="unit below">{html.escape(x.label)}</p></div>'
    )


def _placed(of: Axis, most: int) -> list[tuple[float, float]]:
    ticks = of.ticks(most)
    return list(zip(ticks.tolist(), of.at(ticks).tolist(), strict=True))


def _tick(value: float) -> str:
    return f"{value:.6g}".replace("-", MINUS)


def _path(px: Floats, py: Floats) -> str:
    parts = []
    for run in _runs(np.isfinite(px) & np.isfinite(py)):
        points = [f"{a:.1f} {b:.1f}" for a, b in zip(px[run].tolist(), py[run].tolist(), strict=True)]
        parts.append("M" + "L".join(points if len(points) > 1 else points * 2))
    return "".join(parts)


def _runs(there: Mask) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
