"""A diagnosis as one page that opens offline: no script, nothing from a network, light or dark as the reader likes."""

import html
from dataclasses import fields
from pathlib import Path

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.result import EARLY, LATE, Diagnosis, Traces
from estimator.diagnosis.thresholds import Thresholds
from estimator.report import wording
from estimator.report.page import figures, tables
from estimator.report.page.document import Section, document, write_document

REMAINDER_SENTENCES = {
    Verdict.NO_GAP: "What is left calls for no further effect.",
    Verdict.EFFECT: "Another effect of the catalogue may still act, but not clearly enough to be added.",
    Verdict.UNKNOWN: "Something is left that no effect of the catalogue explains.",
    Verdict.CANNOT_TELL: "Whether anything is left cannot be told.",
}
GAP_CLOSED = (
    "share in all that was found (effects, road, causes without a name), as mean squares; a road counts as far as "
    "signals show it, and one that none shows as if it were known"
)


def write_page(diagnosis: Diagnosis, path: Path) -> None:
    """Write the page to ``path``; errors as of `write_document`."""
    write_document(page(diagnosis), path)


def page(d: Diagnosis) -> str:
    """The whole document."""
    return document(wording.headline(d), _verdict(d), _sections(d))


def _verdict(d: Diagnosis) -> str:
    logs = html.escape(wording.logs(d))
    line = "".join(f'<p class="note">{html.escape(doubt[:1].upper() + doubt[1:])}</p>' for doubt in d.doubts)
    if configuration := wording.configuration(d):
        line += (
            '<div class="add"><p>Add to the configuration</p>'
            f"<pre><code>{html.escape(configuration)}</code></pre></div>"
        )
    elif beyond := wording.beyond_estimate(d):
        line += f'<p class="note">{html.escape(beyond[:1].upper() + beyond[1:])}.</p>'
    return (
        f'<header class="{d.verdict.value.replace(" ", "-")}"><p class="logs">Diagnosis <span>{logs}</span></p>'
        f'<p class="verdict">{d.verdict.value}</p><h1>{html.escape(wording.headline(d))}</h1>'
        f'<p class="reason">{html.escape(wording.reason(d))}</p>{line}</header>'
    )


def _sections(d: Diagnosis) -> list[Section]:
    return [
        Section("budget", "What is the residual made of?", _budget(d)),
        Section("how-far", "How far does the gap shrink?" if d.effects else "How large is the residual?", _how_far(d)),
        Section("power", "Power, measured and modelled", _power(d)),
        Section("where", "Where does it lie?", _where(d)),
        Section("which", "Which effect?", _which(d)),
        Section("apart", "Which effects cannot be told apart here?", _apart(d)),
        Section("unseen", "What this log cannot say", _unseen(d)),
        Section("left", "What is left?", _left(d)),
        Section("terms", "Terms", _terms(wording.THRESHOLDS) if d.rms_base is not None else ""),
    ]


def _budget(d: Diagnosis) -> str:
    if d.budget is None:
        return ""
    meaning = (
        '<p class="soft">Shares of the mean square of the model&#x27;s residual over means of 2 s, whose root is '
        f"{wording.kilowatts(d.budget.base)}, with 90 % intervals. Both residuals at the right are of one cause alone; "
        "below, effects are added one to the other. Left once added: on held-out stretches, with the signals there "
        "are. Left if it were known: to be expected with a signal of its own, without effects that were not found. "
        "Causes may cancel each other in part; then more is left without one of them. The gap is "
        f"everything except the noise of the sensors.{_aligned(d)}</p>"
    )
    return figures.budget(d.budget) + tables.budget(d.budget) + meaning


def _aligned(d: Diagnosis) -> str:
    """Sentence on what a lag took before; empty without one."""
    lag = next((effect for effect in d.effects if effect.name in (LATE, EARLY)), None)
    if lag is None:
        return ""
    change = f"from {wording.kilowatts(lag.rms_before)} to {wording.kilowatts(lag.rms_after)}"
    return f" The {wording.label(lag.name)} is taken out before, which reduces the residual {change}."


def _how_far(d: Diagnosis) -> str:
    bars, caption = figures.bars(d), f'<p class="soft">{html.escape(_of_the_bars(d))}</p>'
    return (
        f'<div class="columns"><div>{bars}{caption}</div>{tables.chosen(d)}</div>' if bars else ""
    ) + tables.parameters(d)


def _of_the_bars(d: Diagnosis) -> str:
    """Caption: of what each bar is the root mean square, and of what the shares beside it are."""
    said = ["Root mean square of the residual. The plain road load is fitted to the whole drive."]
    if d.effects or d.given:
        said.append("Effects are judged on stretches left out of the fit.")
    if known := wording.road_known(d):
        said.append(f"The {wording.base_name(d)} {known[0]}: expected with true slopes.")
    elif wording.if_road_were_exact(d) is not None:
        said.append("If its road were exact: expected with true slopes.")
    said.append("Grey is the noise floor, colour what lies above it.")
    return " ".join([*said, f"Gap closed: {GAP_CLOSED}."] if d.effects else said)


def _power(d: Diagnosis) -> str:
    traces = _complete(d.traces)
    if traces is None:
        return ""
    most = "the effects change most" if d.effects else "the model misses most"
    return (
        f'<p class="soft">The five minutes in which {most}.</p>'
        f"{figures.power(traces, wording.base_name(d), figures.improved(d, traces))}"
    )


def _where(d: Diagnosis) -> str:
    parts, traces = [], _complete(d.traces)
    better = None if traces is None else figures.improved(d, traces)
    if d.gap_map is not None:
        parts.append("<h3>Over speed and acceleration</h3>" + figures.gap_map(d.gap_map, wording.base_name(d), better))
    if traces is not None:
        parts.append("<h3>In time</h3>" + figures.in_time(traces, d, better))
        parts.append("<h3>Along the road</h3>" + figures.along_the_road(traces, d, better))
    if d.where:
        heading = f"Places where the {wording.base_name(d)} errs by more than noise"
        parts.append(f"<h3>{html.escape(heading)}</h3>{tables.where(d.where)}")
    return "".join(parts)


def _complete(traces: Traces | None) -> Traces | None:
    """The seconds in which everything is known; None where they make no line."""
    if traces is None:
        return None
    columns = np.array([getattr(traces, column.name) for column in fields(Traces)])
    columns = columns[:, np.isfinite(columns).all(axis=0)]
    if columns.shape[1] < 2:
        return None
    return Traces(**{field.name: column for field, column in zip(fields(Traces), columns, strict=True)})


def _which(d: Diagnosis) -> str:
    said = wording.p_value(d)
    return tables.ranking(d.ranking, len(d.logs) > 1) + (f"<p>p value {html.escape(said)}.</p>" if said else "")


def _apart(d: Diagnosis) -> str:
    return "" if d.isolability is None else tables.of_the_longest(d) + tables.isolability(d.isolability)


def _unseen(d: Diagnosis) -> str:
    parts = []
    if d.invisible:
        parts.append("<h3>Could be there unseen</h3>" + tables.of_the_longest(d) + tables.invisible(d.invisible))
    if d.not_testable:
        parts.append("<h3>Not testable without another signal</h3>" + tables.not_testable(d.not_testable))
    if d.advice:
        items = "".join(f"<li>{html.escape(a)}</li>" for a in wording.advice(d))
        parts.append(f'<h3>What would tell</h3><ul class="advice">{items}</ul>')
    return "".join(parts)


def _left(d: Diagnosis) -> str:
    if d.rms_base is None:
        return ""
    strength = ""
    if d.remaining_log_bayes_factor is not None:
        strength = f" Log Bayes factor of a further cause without a name: {wording.strength_of_rest(d)}."
    final = d.rms_base if d.rms_final is None else d.rms_final
    formula = f" A power of {html.escape(wording.formula(d))}." if d.formula is not None else ""
    return (
        f"<p>{REMAINDER_SENTENCES[d.remaining_verdict]}{strength}{formula} "
        f"The residual is {wording.with_exact_road(d, final)}{_if_known(d)}; "
        f"the noise floor is {wording.kilowatts(d.noise_floor)}.</p>"
    )


def _if_known(d: Diagnosis) -> str:
    """Residual that the model as configured would leave if the road were known; empty where signals show it."""
    known = wording.road_known(d)
    return "" if known is None else f" (that of the {wording.base_name(d)} is {wording.kilowatts(known[1])} {known[0]})"


def terms(limits: Thresholds) -> dict[str, str]:
    """Meaning of the words and figures of the page, with the ``limits`` of the diagnosis."""
    return {
        "residual": "measured power minus the model's; above zero, the vehicle needs more power than the model says",
        "noise floor": "residual that no road-load model can take away: noise of torque and speed",
        "gap closed": GAP_CLOSED,
        "probability": (
            "that the effect acts, among all causes that the log may have; an effect is named from "
            f"{wording.percent(limits.min_probability)} on, alone or together with one that may act in its place"
        ),
        "log Bayes factor": (
            "natural logarithm of how much more probable the log is with the effect than without; an effect is named "
            "by its probability, which also counts what else may act; of one that is named it is beside all others, of "
            "another one alone"
        ),
        "q value": "share of false places to be expected among those listed down to this one",
        "isolability": (
            "how alike the powers of two effects run on this log, in per cent: from "
            f"{100 * limits.min_class_correlation:.0f} on they cannot be told apart; others, too, may explain a log "
            "equally well, and are then listed as not told apart"
        ),
        "visible?": (
            "log Bayes factor expected of the effect at its usual size; below "
            f"{limits.min_expected_log_bf:g} it would go unnoticed"
        ),
    }


def _terms(limits: Thresholds) -> str:
    listed = "".join(f"<dt>{name}</dt><dd>{meaning}</dd>" for name, meaning in terms(limits).items())
    return f"<dl>{listed}</dl>"
