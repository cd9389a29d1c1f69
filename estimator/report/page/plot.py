"""Plots that fit any width: shapes in an inline SVG that stretches, labels in HTML that keep their size.

Positions inside the drawing run from 0 to `SIDE` both ways; strokes do not scale (see the style sheet). Colours come
from classes, so that they follow the reader's light or dark scheme.
"""

import html
import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from estimator.report.number_format import MINUS
from estimator.signals import Floats, Mask
from estimator.units import HOUR

CLOCK = "time since the first frame [h:mm]"
SIDE = 1000  # units of the drawing, each way
DAY = 86_400.0  # s
DAYS_OF_YEAR = 366.0
MAX_DAYS_BY_DAY = 62.0  # of an axis whose ticks are days; those of a longer one are months
CLOCK_STEPS = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0)  # s
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

    def text(self, value: float) -> str:
        """The label of a tick."""
        return f"{value:.6g}".replace("-", MINUS)

    def ticks(self, most: int) -> Floats:
        """At most ``most`` round values (k,) inside the axis."""
        rough = (self.high - self.low) / most
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * s for s in STEPS if power * s >= rough * (1 - 1e-9))
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return np.arange(first, last + 1) * step


class ClockAxis(Axis):
    """An axis of seconds since the first frame, whose ticks are hours and minutes, and seconds where it is short."""

    def text(self, value: float) -> str:
        """``0:05``, or ``0:05:30``."""
        seconds = round(value)
        parts = f"{seconds // 3600}:{seconds // 60 % 60:02}"
        return parts if self.high - self.low > HOUR / 20 else f"{parts}:{seconds % 60:02}"

    def ticks(self, most: int) -> Floats:
        """At most ``most`` times (k,) that are round on a clock."""
        rough = (self.high - self.low) / most
        steps = (*CLOCK_STEPS, *(HOUR * n for n in (1, 2, 3, 6, 12)), DAY * math.ceil(rough / DAY))
        step = next(s for s in steps if s >= rough)
        return np.arange(math.ceil(self.low / step), math.floor(self.high / step) + 1) * step


class DateAxis(Axis):
    """An axis of days since 1970, whose ticks are dates."""

    def text(self, value: float) -> str:
        """The day and the month; of a longer axis the month, and the year where it begins or several are shown."""
        date = datetime.fromtimestamp(DAY * value, UTC)
        month = f"{date:%b}"
        if self.high - self.low > MAX_DAYS_BY_DAY:
            return f"{month} {date:%Y}" if date.month == 1 or self.high - self.low > DAYS_OF_YEAR else month
        return f"{date.day} {month}"

    def ticks(self, most: int) -> Floats:
        """At most ``most`` days (k,), or first days of months."""
        if self.high - self.low <= MAX_DAYS_BY_DAY:
            step = max(math.ceil((self.high - self.low) / most), 1)
            return np.arange(math.ceil(self.low), math.floor(self.high) + 1, step, dtype=np.float64)
        first, last = (datetime.fromtimestamp(DAY * day, UTC) for day in (self.low, self.high))
        months = range(12 * first.year + first.month, 12 * last.year + last.month)  # but the first, which has begun
        most = most // 2 if self.high - self.low > DAYS_OF_YEAR else most  # their labels are longer
        every = next(n for n in (1, 2, 3, 6, *range(12, 12_000, 12)) if len(months) <= n * most)
        starts = [datetime(m // 12, m % 12 + 1, 1, tzinfo=UTC) for m in months if m % every == 0]
        return np.array([start.timestamp() / DAY for start in starts])


def axis(values: Iterable[float], label: str, *, zero: bool = False, margin: float = 0.0) -> Axis:
    """An axis over the finite ones of ``values``, with ``zero`` inside and a margin as a share of the range."""
    finite = [v for v in values if math.isfinite(v)] + ([0.0] if zero else [])
    low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
    if not high - low > 1e-9 * max(abs(low), abs(high)):
        low, high = low - 0.5, high + 0.5
    room = margin * (high - low)
    return Axis(low - room, high + room, label)


def clock_axis(times: Floats, label: str = CLOCK) -> ClockAxis:
    """An axis over ``times`` (n,) [s]."""
    span = axis(times.tolist(), label)
    return ClockAxis(span.low, span.high, label)


def line(x: Axis, y: Axis, xs: Floats, ys: Floats, kind: str) -> str:
    """A line through ``xs``, ``ys`` (n,) of CSS class ``kind``, broken where either is NaN."""
    return f'<path class="{kind}" d="{_path(x.at(xs), SIDE - y.at(ys))}"/>'


def dots(x: Axis, y: Axis, xs: Floats, ys: Floats, kind: str) -> str:
    """Round dots at ``xs``, ``ys`` (n,) of CSS class ``kind``; empty without any."""
    if not len(xs):
        return ""
    places = zip(x.at(xs).tolist(), (SIDE - y.at(ys)).tolist(), strict=True)
    return f'<path class="dots {kind}" d="{"".join(f"M{a:.1f} {b:.1f}h0" for a, b in places)}"/>'


def rods(x: Axis, y: Axis, xs: Floats, low: Floats, high: Floats, kind: str) -> str:
    """Vertical lines at ``xs`` (n,) from ``low`` to ``high`` (n,)."""
    ends = zip(x.at(xs).tolist(), (SIDE - y.at(low)).tolist(), (SIDE - y.at(high)).tolist(), strict=True)
    return f'<path class="rods {kind}" d="{"".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in ends)}"/>'


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


def plot(shapes: str, x: Axis, y: Axis, description: str, title: str = "", kind: str = "", most: int = 8) -> str:
    """The drawing with its axes, ``most`` ticks across; ``description`` is its text for screen readers."""
    grid, labels = [], []
    for value, at in _placed(x, most):
        grid.append(f'<path class="grid" d="M{at:.1f} 0V{SIDE}"/>')
        labels.append(f'<span class="x" style="left:{at / SIDE:.2%}">{x.text(value)}</span>')
    for value, at in _placed(y, 5):
        rule = "zero" if value == 0 else "grid"
        grid.append(f'<path class="{rule}" d="M0 {SIDE - at:.1f}H{SIDE}"/>')
        labels.append(f'<span class="y" style="bottom:{at / SIDE:.2%}">{y.text(value)}</span>')
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


def _path(px: Floats, py: Floats) -> str:
    parts = []
    for run in _runs(np.isfinite(px) & np.isfinite(py)):
        points = [f"{a:.1f} {b:.1f}" for a, b in zip(px[run].tolist(), py[run].tolist(), strict=True)]
        parts.append("M" + "L".join(points if len(points) > 1 else points * 2))
    return "".join(parts)


def _runs(there: Mask) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
