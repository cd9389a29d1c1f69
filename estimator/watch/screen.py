"""The view on a terminal of any size: numbers beside the coverage map where both fit, one above the other else."""

import math
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from estimator.answers.run import Parameter, Quantiles
from estimator.answers.status import Progress
from estimator.answers.watch import WatchAnswer
from estimator.estimates import Status
from estimator.printable import printable
from estimator.report.number_format import clock
from estimator.report.parameter_text import ROWS, Row, beside
from estimator.watch import coverage_map
from estimator.watch.coverage_map import ASCII, BLOCKS, Glyphs

COLOURS = {Status.ESTIMATED: "green", Status.UNESTIMATED: "yellow", Status.INVALID: "red"}
BESIDE = 72  # columns from which on the map stands beside the numbers
NUMBERS, MAX_NUMBERS = 43, 90  # columns of the numbers beside a map
REASONS = 5  # of unused moments that are named
MIN_SHARE = 0.005  # of an unused reason that is named
NAME = 9  # columns of a name, as `estimate` prints them


@dataclass(frozen=True)
class Screen:
    """A renderable of one view."""

    view: WatchAnswer
    address: str = ""  # of the page, where there is one

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Lines that fit the width and the height."""
        glyphs = ASCII if options.ascii_only else BLOCKS
        height = (options.height or console.height) - bool(self.address)
        shown = lines(self.view, options.max_width, height, glyphs)
        if self.address:
            shown.insert(1, Text(self.address, "dim"))
        for line in shown:
            line.truncate(options.max_width, overflow="crop" if options.ascii_only else "ellipsis")
            line.no_wrap = True
            yield line


def lines(view: WatchAnswer, width: int, height: int, glyphs: Glyphs = BLOCKS) -> list[Text]:
    """The view in at most ``height`` lines, made for ``width`` columns."""
    head = [_title(view, width), *_status(view, width), Text()]
    room = max(height - len(head) - 1, 0)  # the last line stays free, so that nothing scrolls
    if view.progress is None:
        return head[: height - 1]
    cells = view.progress.coverage_map
    if width < BESIDE:
        numbers = list(_numbers(view, width, glyphs, is_brief=True))
        plan = coverage_map.plan(cells, width, room - len(numbers) - 1, glyphs)
        return [*head, *numbers, *plan, *_unused(view, width)][: height - 1]
    plan = coverage_map.plan(cells, width - NUMBERS - 2, room, glyphs)
    left = min(width - max((line.cell_len for line in plan), default=0) - 2, MAX_NUMBERS)
    numbers = [*_numbers(view, left, glyphs), Text(), *_unused(view, left)]
    return [*head, *_beside(numbers[:room], plan, left)][: height - 1]


def _title(view: WatchAnswer, width: int) -> Text:
    """Source and state, with time and rate at the right."""
    share = "" if view.share is None else f" {100 * view.share:.0f} %"
    time = "" if view.progress is None or view.progress.t_s is None else f"  {clock(view.progress.t_s)}"
    rate = "" if view.frames_per_s is None else f"  {view.frames_per_s:,.0f} frames/s"
    right = f"{view.state}{share}{time}{rate}"
    left = printable(view.source)
    if len(left) + len(right) + 2 > width:
        left = left[: max(width - len(right) - 3, 8)] + "…" if width - len(right) > 12 else ""
    gap = " " * max(width - len(left) - len(right), 0) if left else ""
    return Text.assemble((left, "bold"), gap, right)


def _status(view: WatchAnswer, width: int) -> list[Text]:
    """The headline, and what is wrong."""
    conclusion = view.estimate
    colour = "yellow" if conclusion is None else COLOURS[conclusion.status]
    lines = [Text(line, f"bold {colour}") for line in _wrapped(view.sentences.headline, width)[:2]]
    return lines + [Text(line, "red") for line in _wrapped(view.note, width)[:2]]


def _numbers(view: WatchAnswer, width: int, glyphs: Glyphs, is_brief: bool = False) -> Iterator[Text]:
    """Mass, A and C with their past, the road, coverage, and what is wanted."""
    conclusion, progress = view.estimate, view.progress
    if conclusion is not None and progress is not None and conclusion.status is Status.ESTIMATED:
        for row in ROWS:
            also = beside(row, conclusion.coefficients)
            yield from _parameter(row, row.of(conclusion.parameters), also, progress, width, glyphs, is_brief)
        age = f"concluded {clock(conclusion.age_s)} ago" if conclusion.age_s >= 0 else ""
        if age and not is_brief:
            yield Text(f"{'':{NAME}}{age}", "dim")
    if view.sentences.road:
        yield from _named("road", view.sentences.road, width, 1 if is_brief else 4)
    if conclusion is not None and conclusion.coverage.available:
        c = conclusion.coverage
        share = f"{100 * c.fraction:.0f} % ({c.occupied} of {c.available} cells)"
        yield from _named("coverage", share, width)
    if progress is not None:
        yield from _named("samples", f"{progress.samples:,} used", width)
    if view.sentences.wanted:
        yield from _named("wanted", view.sentences.wanted, width, 2 if is_brief else 4)


def _parameter(
    row: Row, x: Parameter, also: str, progress: Progress, width: int, glyphs: Glyphs, is_brief: bool
) -> Iterator[Text]:
    """Value, interval, what follows from it, and how the interval narrowed; as many of them as there is room for."""
    if x.mean is None or x.q05 is None or x.q95 is None:
        yield from _named(row.name, x.reason, width, 1 if is_brief else 2)
        return
    name, value = (f"{row.name:{NAME}}" if width >= 2 * NAME + 10 else f"{row.name} "), row.value(x.mean)
    interval = row.interval(x.q05, x.q95)
    spread = f"± {100 * x.sd / abs(x.mean):.2f} %" if x.mean and x.sd is not None else ""
    spread = "  ".join(part for part in (spread, "" if is_brief else also) if part)
    past = [p for p in (_past(row, point) for point in progress.history) if p is not None]
    chart = sparkline([p.q95 - p.q05 for p in past], max(width - NAME - len(spread) - 1, 0), glyphs)
    if is_brief:
        forms = (f"{name}{value:16} {interval}", f"{name}{value}  {interval}", f"{name}{value} {spread}")
        yield Text(next((form for form in forms if len(form) <= width), f"{name}{value}"))
        return
    yield Text.assemble(f"{name}", (f"{value:16} ", "bold"), interval)
    yield Text.assemble(f"{'':{NAME}}", (spread, "dim"), " ", (chart, "cyan"))


def _past(row: Row, point: object) -> Quantiles | None:
    quantiles: Quantiles | None = getattr(point, row.key)
    return quantiles


def sparkline(widths: list[float], columns: int, glyphs: Glyphs = BLOCKS) -> str:
    """The newest ``columns`` widths on a logarithmic scale, from the least to the greatest of them."""
    shown = [math.log(w) for w in widths[-columns:] if w > 0] if columns else []
    if len(shown) < 2:
        return ""
    low, high = min(shown), max(shown)
    top = len(glyphs.heights) - 1
    return "".join(glyphs.heights[round(top * (w - low) / (high - low)) if high > low else 0] for w in shown)


def _unused(view: WatchAnswer, width: int) -> list[Text]:
    """Reasons of moments that are not used, with their shares of all moments."""
    total = sum(view.unused.values()) + (0 if view.progress is None else view.progress.samples)
    shown = [(reason, count / total) for reason, count in view.unused.items() if count > MIN_SHARE * total]
    if not shown:
        return []
    parts = ", ".join(f"{printable(reason)} {100 * share:.0f} %" for reason, share in shown[:REASONS])
    return list(_named("not used", parts, width, 4))


def _named(name: str, text: str, width: int, most: int = 2) -> Iterator[Text]:
    """A name and a text in at most ``most`` lines; on a narrow screen the name has no column of its own."""
    indent = NAME if width >= 4 * NAME else 0
    wrapped = _wrapped(text if indent else f"{name} {text}", width - indent)
    if len(wrapped) > most:
        wrapped = [*wrapped[: most - 1], f"{wrapped[most - 1][: max(width - indent - 1, 1)]}…"]
    for i, line in enumerate(wrapped):
        yield Text(f"{name if not i else '':{NAME}}{line}" if indent else line)


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(printable(text), max(width, 8))


def _beside(left: list[Text], right: list[Text], width: int) -> Iterator[Text]:
    for i in range(max(len(left), len(right))):
        line = left[i].copy() if i < len(left) else Text()
        line.truncate(width, overflow="ellipsis", pad=True)
        yield Text.assemble(line, "  ", right[i]) if i < len(right) else line
