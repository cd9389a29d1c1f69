"""The tables of the page; a narrow screen shows each row as a card, so that no column is lost."""

import html
import math
from collections.abc import Sequence

from estimator.components.budget import Budget
from estimator.diagnosis.result import Diagnosis, Finding, GapClosed, Invisible, Isolability, NotTestable, Place
from estimator.report import number_format, usual_units, wording

MAX_ROWS = 8  # of a long table; the others are folded away


def ranking(candidates: Sequence[Finding], several: bool) -> str:
    """Candidates with their probabilities, best first; ``several`` logs have numbers."""
    headings = ("effect", "probability", "log Bayes factor", "size", "gap closed", "acts", "not told apart from")
    rows = [
        (
            _name(f.name),
            _meter(f.probability, html.escape(wording.percent(f.probability))),
            wording.bayes(f.log_bayes_factor),
            html.escape(wording.size(f.magnitude)),
            html.escape(wording.interval(f.gap_closed)),
            html.escape(f.detail or wording.times(f.span, several) or number_format.NOTHING),
            html.escape(", ".join(wording.label(e) for e in f.equivalent) or number_format.NOTHING),
        )
        for f in candidates
    ]
    return _folded(headings, rows, "ranking")


def chosen(d: Diagnosis) -> str:
    """Effects that are named: size, action, share of the gap closed with its interval."""
    blocks = []
    for f in d.effects:
        share, action = _interval_bar(f.gap_closed), wording.action(f, len(d.logs) > 1)
        how = "" if action == number_format.NOTHING else f"<p class='soft'>{html.escape(action)}</p>"
        blocks.append(
            f"<li><h3>{html.escape(wording.with_equivalents(f))}</h3><p>{html.escape(wording.size(f.magnitude))}, "
            f"<span class='whole'>probability {html.escape(wording.percent(f.probability))}</span></p>"
            f"{how}<p>{html.escape(wording.closes(d, f) or number_format.NOTHING)}</p>{share}</li>"
        )
    return f'<ul class="chosen">{"".join(blocks)}</ul>' if blocks else ""


def parameters(d: Diagnosis) -> str:
    """A, C and m of the model as configured, and with the effects found; without these, averaged over hypotheses."""
    if d.base is None:
        return ""
    base = html.escape(wording.base_name(d))
    title = "What it does to the parameters" if d.effects else f"Parameters of the {base}"
    title = f"<h3>{title}</h3>" + of_the_longest(d)
    if d.final is not None and not d.effects:  # least squares alone would have the sd of the noise
        rows = [
            [
                f"{name} [{unit}]",
                wording.parameter_with_sd(getattr(d.final, key), getattr(d.deviation, key, math.nan), step),
            ]
            for key, (name, unit, step) in zip(("mass", "A", "C"), wording.PARAMETERS, strict=True)
        ]
        return title + table(("parameter", "averaged over the hypotheses"), rows, "parameters")
    rows = []
    for attribute, (name, unit, step) in zip(("mass", "A", "C"), wording.PARAMETERS, strict=True):
        before = getattr(d.base, attribute)
        row = [
            f"{name} [{unit}]",
            wording.parameter_with_sd(before, getattr(d.base_deviation, attribute, math.nan), step),
        ]
        if d.final is not None:
            after = getattr(d.final, attribute)
            relative = (after - before) / before if before > 0 else math.nan  # no share of what cannot be negative
            share = f" ({number_format.signed(f'{100 * relative:+.1f}')} %)" if math.isfinite(relative) else ""
            sd = getattr(d.deviation, attribute, math.nan)
            row += [wording.parameter_with_sd(after, sd, step), wording.parameter(after - before, step, "+") + share]
        rows.append(row)
    headings = ("parameter", base, "with the effects", "shift")
    return title + table(headings[: len(rows[0])], rows, "parameters")


def of_the_longest(d: Diagnosis) -> str:
    """Which of several drives a table is of."""
    said = wording.of_the_longest(d)
    return f'<p class="soft">{said[:1].upper()}{said[1:]}.</p>' if said else ""


def budget(whole: Budget) -> str:
    """Every part of the residual: share, size, and what would be left."""
    headings = ("cause", "share of the residual", "of its own", "left once added alone", "left if it alone were known")
    rows = [
        (
            html.escape(wording.cause(part)),
            html.escape(wording.interval(GapClosed(part.share, part.q05, part.q95))),
            *map(wording.kilowatts, (part.rms, part.held_out_rms, part.expected)),
        )
        for part in whole.parts
    ]
    return table(headings, rows, "budget")


def where(places: Sequence[Place]) -> str:
    """Parts of the axes where the residual is not zero."""
    headings = ("along", "from", "to", "mean residual", "share of the squared residual", "q value")
    rows = [
        (
            html.escape(wording.label(p.axis)),
            *map(html.escape, usual_units.ends(p.start, p.end, p.unit)),
            wording.kilowatts(p.bias),
            _meter(p.share, html.escape(wording.percent(p.share))),
            "&lt; 0.001" if p.q_value < 0.001 else number_format.number(p.q_value),
        )
        for p in places
    ]
    return _folded(headings, rows, "where")


def not_testable(effects: Sequence[NotTestable]) -> str:
    """Effects that the log cannot test."""
    rows = [(_name(n.name), html.escape(n.needs)) for n in effects]
    return table(("effect", "needs"), rows, "needs")


def invisible(effects: Sequence[Invisible]) -> str:
    """Effects that could act without being visible, and the change of the parameters by each."""
    headings = ("effect", "expected log Bayes factor", "would shift", "what would show it")
    rows = [
        (
            _name(i.name),
            wording.bayes(i.expected_log_bayes_factor),
            html.escape(wording.shift(i.shift)),
            html.escape(i.shown_by),
        )
        for i in effects
    ]
    return table(headings, rows, "invisible")


def isolability(of: Isolability) -> str:
    """Matrix of |correlation|, the visibility of each effect, and in words which cannot be told apart."""
    head = "".join(f'<th scope="col" title="{_name(name)}">{i}</th>' for i, name in enumerate(of.names, 1))
    rows = []
    for i, name in enumerate(of.names):
        cells = "".join(_correlation(of, i, j) for j in range(len(of.names)))
        expected = float(of.expected_log_bayes_factor[i])
        seen = "seen" if expected >= wording.THRESHOLDS.min_expected_log_bf else "unseen"
        rows.append(
            f'<tr><th scope="row"><small>{i + 1}</small> {_name(name)}</th>'
            f'<td class="{seen}">{wording.bayes(expected)}</td>{cells}</tr>'
        )
    matrix = (
        f'<div class="scroll" tabindex="0" role="region" aria-label="Isolability matrix"><table class="matrix">'
        f'<thead><tr><td></td><th scope="col">visible?</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )
    pairs = [
        f"{wording.label(of.names[i])} and {wording.label(of.names[j])}"
        for i in range(len(of.names))
        for j in range(i)
        if abs(of.correlation[i, j]) >= wording.THRESHOLDS.min_class_correlation
    ]
    alike = f"Their powers run alike on this drive: {'; '.join(pairs)}."
    words = alike if pairs else "No two effects have powers that run alike on this drive."
    return f"<p>{html.escape(words)}</p><details><summary>Correlations of all effects</summary>{matrix}</details>"


def table(headings: Sequence[str], rows: Sequence[Sequence[str]], kind: str) -> str:
    """A table of cells that are HTML already, without empty columns; empty without rows."""
    if not rows:
        return ""
    said = [i for i in range(len(headings)) if any(row[i] != number_format.NOTHING for row in rows)]
    headings, rows = [headings[i] for i in said], [[row[i] for i in said] for row in rows]
    head = "".join(f'<th scope="col">{h}</th>' for h in headings)
    body = "".join(
        "<tr>"
        + f'<th scope="row">{row[0]}</th>'
        + "".join(f'<td data-label="{h}"{_none(c)}>{c}</td>' for h, c in zip(headings[1:], row[1:], strict=True))
        + "</tr>"
        for row in rows
    )
    return f'<table class="data {kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _folded(headings: Sequence[str], rows: Sequence[Sequence[str]], kind: str) -> str:
    """A table whose rows after the first MAX_ROWS are folded away, under their number."""
    first, others = table(headings, rows[:MAX_ROWS], kind), rows[MAX_ROWS:]
    if not others:
        return first
    return f"{first}<details><summary>{len(others)} more</summary>{table(headings, others, kind)}</details>"


def _correlation(of: Isolability, i: int, j: int) -> str:
    r = abs(float(of.correlation[i, j]))
    if i == j or not math.isfinite(r):
        return '<td class="self"></td>'
    words = html.escape(f"{wording.label(of.names[i])} and {wording.label(of.names[j])}: {r:.2f}")
    alike = " alike" if r >= wording.THRESHOLDS.min_class_correlation else ""
    text = f"<span>{100 * r:.0f}</span>"
    return f'<td class="r{alike}" style="--r:{100 * min(r, 1) ** 2:.0f}%" title="{words}">{text}</td>'


def _none(content: str) -> str:
    return ' class="none"' if content == number_format.NOTHING else ""


def _name(name: str) -> str:
    return html.escape(wording.label(name))


def _meter(share: float, text: str) -> str:
    width = 100 * min(max(share, 0.0), 1.0) if math.isfinite(share) else 0.0
    return f'<span class="meter"><b class="bar"><i class="after" style="width:{width:.1f}%"></i></b>{text}</span>'


def _interval_bar(closed: GapClosed | None) -> str:
    if closed is None:
        return ""
    low, value, high = (100 * min(max(q, 0.0), 1.0) for q in (closed.q05, closed.fraction, closed.q95))
    if not all(map(math.isfinite, (low, value, high))):
        return ""
    return (
        f'<b class="bar" role="img" aria-label="gap closed {html.escape(wording.interval(closed))}">'
        f'<i class="after" style="width:{value:.1f}%"></i>'
        f'<i class="whisker" style="left:{low:.1f}%;width:{max(high - low, 0.5):.1f}%"></i></b>'
    )
