"""A diagnosis in words and rounded numbers, the same on the terminal and on the page."""

import math

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, Part
from estimator.diagnosis.result import (
    EARLY,
    HIDDEN_GRADE,
    LATE,
    SHOWN_SLOPE,
    Diagnosis,
    Experiment,
    Finding,
    GapClosed,
    Magnitude,
    Shift,
    Span,
)
from estimator.diagnosis.thresholds import Thresholds
from estimator.report import number_format
from estimator.report.number_format import NOTHING, clock, exponent, signed

MAX_SPANS = 3  # spans that are listed
SMALL_GAP = 0.1  # of the squared residual: below, the headline says how small it is
MIN_GAIN = 3.0  # in log Bayes factor, from which an experiment is worth its while: 20 to 1
THRESHOLDS = Thresholds()  # by which a diagnosis is made, unless it is given others
PARAMETERS = (("mass", "kg", 1), ("A", "N", 1), ("C", "N s²/m²", 0.001))  # name, unit, step worth showing


def label(name: str) -> str:
    """Name of an effect in a sentence; the configuration keeps its underscores."""
    return name.replace("_", " ")


def cause(part: Part) -> str:
    """Name of a part of the budget; of a given cause the part is the error."""
    return f"error of {label(part.cause)}" if part.is_given else label(part.cause)


def with_equivalents(effect: Finding) -> str:
    """Name of an effect, and of those that may act in its place."""
    others = " or ".join(label(name) for name in effect.equivalent)
    return label(effect.name) + (f" (or {others})" if others else "")


def headline(d: Diagnosis) -> str:
    """The verdict as one sentence; `reason` is the next one."""
    named = listed([with_equivalents(effect) for effect in d.effects])
    match d.verdict:
        case Verdict.EFFECT:
            closed = gap_closed(d)
            share = "part" if closed is None else percent(closed)
            gap = gap_share(d)
            small = f", which is {percent(gap)} of the residual" if gap is not None and gap < SMALL_GAP else ""
            return f"{_capital(named)} account{'s' if len(d.effects) == 1 else ''} for {share} of the gap{small}."
        case Verdict.UNKNOWN:
            beside = f"Beside {named}, an" if named else "An"
            return f"{beside} effect outside the catalogue acts on this drive."
        case Verdict.NO_GAP:
            return "No gap: this drive calls for no effect beyond the model."
        case Verdict.CANNOT_TELL:
            return "This log cannot tell what separates the model from the engine."


def reason(d: Diagnosis) -> str:
    """One or two sentences that a person can act on."""
    if d.obstacle:
        return f"Cannot tell: {d.obstacle}."
    match d.verdict:
        case Verdict.NO_GAP:
            hidden = f"; too small to see here: {', '.join(label(i.name) for i in d.invisible)}" if d.invisible else ""
            return f"The model describes this drive to {with_exact_road(d, d.rms_base)}{hidden}."
        case Verdict.UNKNOWN:
            size = "" if d.remainder is None else f": {d.remainder.name}, {kilowatts(d.remainder.rms)}"
            return f"Something is missing that no known effect explains{size} of {kilowatts(d.rms_base)}."
        case Verdict.CANNOT_TELL:
            return _doubt(d)
        case Verdict.EFFECT:
            return _improvement(d)


def with_exact_road(d: Diagnosis, rms: float | None) -> str:
    """A residual ``rms`` [W] of the model without effects, and the smaller one that an exact road would leave."""
    left = if_road_were_exact(d)
    return kilowatts(rms) + ("" if left is None else f" ({kilowatts(left)} if its road were exact)")


def if_road_were_exact(d: Diagnosis) -> float | None:
    """Residual [W] that an exact road would leave the model in which no effect is found; None if it is not smaller."""
    road = None if d.budget is None else d.budget.part(ROAD)
    if d.rms_base is None or road is None or d.effects or road.expected >= d.rms_base:
        return None
    return road.expected


def strength_of_rest(d: Diagnosis) -> str:
    """Log Bayes factor of a further cause without a name; a large one that is dismissed has its reason."""
    best = d.remaining_log_bayes_factor
    is_large = best is not None and best > THRESHOLDS.min_log_bf_unknown
    is_dismissed = is_large and bool(d.effects) and d.remaining_verdict is Verdict.NO_GAP
    return bayes(best) + (", too little beside effects whose form is not exact" if is_dismissed else "")


def p_value(d: Diagnosis) -> str:
    """P-value with its meaning; empty where it was not asked for."""
    return "" if d.p_value is None else f"{d.p_value:.3g}: how often noise alone gives an effect as much evidence"


def formula(d: Diagnosis) -> str:
    """Formula of the residual that has no name, and how well it describes it; empty if there is none."""
    if d.formula is None:
        return ""
    size = number_format.with_sd(d.formula.value, d.formula.sd, d.formula.unit)
    return (
        f"({size}) {d.formula.text} follows it (v speed, a acceleration, F force, n engine speed, t time, s distance): "
        f"with it {percent(d.formula.share)} of the squared residual is gone on stretches left out of the fit"
    )


def _doubt(d: Diagnosis) -> str:
    if d.effects and d.effects[0].equivalent:
        rivals = " or ".join(map(label, (d.effects[0].name, *d.effects[0].equivalent)))
        return f"The drive shows {rivals}, and cannot tell which."
    doubtful = d.effects[0].name if d.effects else d.doubtful
    return f"There may be {label(doubtful)}, too weak on this drive to be sure." if doubtful else "Cannot tell."


def _improvement(d: Diagnosis) -> str:
    first = d.effects[0]
    if is_hidden(first):
        seen = f"A force varies with place like a grade of {100 * first.magnitude.value:.1f} % sd"
        fall = f"from {kilowatts(first.rms_before)} to {kilowatts(first.rms_after)}"
        beside = listed([f"{label(f.name)} ({_quantity(f.magnitude)} {_value(f.magnitude)})" for f in d.effects[1:]])
        also = f" Beside it acts {beside}." if beside else ""
        aside = "".join(f" of the {base_name(d)}, {words}," for words in _aside(d, first))
        return (
            f"{seen}, and no signal on the bus shows it: with one, the residual{aside} could fall {fall}; "
            f"roadload estimate counts with such a road by itself.{also}"
        )
    effects = listed([f"{label(f.name)} ({size(f.magnitude)})" for f in d.effects])
    steps = ladder(d)
    before, after = steps[0][1], steps[-1][1]
    if after >= before:
        change = f"does not fall on stretches kept from the fit ({kilowatts(before)}, then {kilowatts(after)})"
    elif kilowatts(before) == kilowatts(after):
        change = f"falls by {percent(1 - (after / before) ** 2)} in mean square, from {kilowatts(before)}"
    else:
        change = f"falls from {kilowatts(before)} to {kilowatts(after)}"
    return f"With {effects} in the model the residual {change}."


def advice(d: Diagnosis) -> list[str]:
    """Signals to measure and manoeuvres to drive, by effect, and experiments that likely settle what is open."""
    signals = [f"{label(each.name)}: {each.shown_by}" for each in d.advice]
    return [*signals, *(_experiment(e) for e in d.experiments if is_worthwhile(d, e))]


def is_worthwhile(d: Diagnosis, e: Experiment) -> bool:
    """Whether an experiment is likely to settle something that is open: to show what the drive alone does not."""
    least = THRESHOLDS.min_expected_log_bf
    return e.now < least < e.expected and e.expected > e.now + MIN_GAIN


def _experiment(e: Experiment) -> str:
    pair = f"{label(e.a)} or {label(e.b) if e.b else 'nothing'}"
    return f"{pair}: {e.what} (log Bayes factor {bayes(e.now)}, to be expected then {bayes(e.expected)})"


def configuration(d: Diagnosis) -> str:
    """The line that adds the effects found to the streaming model; empty if there is nothing to add."""
    quoted = ", ".join(f'"{name}"' for name in d.streaming_effects)
    return f"effects = [{quoted}]" if quoted else ""


def beyond_estimate(d: Diagnosis) -> str:
    """Sentence on effects found that `roadload estimate` cannot have; empty if there are none."""
    if not d.beyond_streaming:
        return ""
    acts, it = ("acts", "it") if len(d.beyond_streaming) == 1 else ("act", "them")
    when = f"no signal shows when {listed([label(name) for name in d.beyond_streaming])} {acts}"
    return f"{when}, so roadload estimate cannot have {it}: take mass, A and C from here"


def gap_closed(d: Diagnosis) -> float | None:
    """Share of the gap that all chosen effects close together; None where it is not known or there was no gap."""
    closed = [effect.gap_closed.fraction for effect in d.effects if effect.gap_closed is not None]
    return min(sum(closed), 1.0) if closed else None


def gap_share(d: Diagnosis) -> float | None:
    """Share of the squared residual that is beyond noise; None where it is not known."""
    if d.rms_base is None or d.noise_floor is None or not d.rms_base > 0:
        return None
    return max(1 - (d.noise_floor / d.rms_base) ** 2, 0.0)


def is_hidden(effect: Finding) -> bool:
    """Whether it is a grade that no signal shows: it is in the model as a state."""
    return effect.magnitude.name == HIDDEN_GRADE


def road_known(d: Diagnosis) -> tuple[str, float] | None:
    """Name and residual [W] of the model as configured if a road that no signal shows were known; None without one.

    A lag is taken out, other effects are not: so it is no step of the `ladder`, and its name says what it leaves aside.
    """
    hidden = next((effect for effect in d.effects if is_hidden(effect)), None)
    if hidden is None:
        return None
    late = [f"{label(f.name)} taken out" for f in d.effects if f.name in (LATE, EARLY)]
    return ", ".join(["if the road were known", *late, *_aside(d, hidden)]), hidden.rms_after


def _aside(d: Diagnosis, hidden: Finding) -> list[str]:
    """``without a and b``: the effects that are named beside a ``hidden`` road, but for a lag; empty if none is."""
    aside = [label(f.name) for f in d.effects if f is not hidden and f.name not in (LATE, EARLY)]
    return [f"without {listed(aside)}"] if aside else []


def base_name(d: Diagnosis) -> str:
    """Name of the model that effects are added to: it has those that the configuration gives."""
    return f"model with {listed([label(name) for name in d.given])}" if d.given else "plain model"


def ladder(d: Diagnosis) -> list[tuple[str, float]]:
    """The residual [W] of the model as configured, and after each effect that is added to it.

    A lag comes first: the others are judged on aligned power. Slopes that no signal shows are those that the force on
    the strides around shows.
    """
    if d.rms_base is None:
        return []
    late = next((effect for effect in d.effects if effect.name in (LATE, EARLY)), None)
    road = None if d.budget is None else d.budget.part(ROAD)
    by_force = None if road is None else road.held_out_rms
    others = [f for f in d.effects if f is not late and not (is_hidden(f) and by_force is None)]
    after = [by_force if by_force is not None and is_hidden(f) else f.rms_after for f in others]
    if after and d.rms_final is not None:
        after[-1] = d.rms_final
    first = [] if late is None else [(_step_name(late), late.rms_after)]
    return [(base_name(d), d.rms_base), *first, *zip(map(_step_name, others), after, strict=True)]


def closes(d: Diagnosis, effect: Finding) -> str:
    """Share of the gap that a named ``effect`` closes, and the fall of the residual beside those named before it.

    What several effects take together is split evenly. So an effect may have no share although the residual falls. The
    fall by the first one alone is not repeated here.
    """
    steps = ladder(d)
    name = _step_name(effect)
    number = next((i for i, (step, _) in enumerate(steps) if step == name), 0)
    (_, before), (_, after) = steps[number - 1 : number + 1] if number > 1 else [("", 0.0)] * 2
    is_less = after < before and kilowatts(after) != kilowatts(before)
    falls = f"takes the residual from {kilowatts(before)} to {kilowatts(after)}" if is_less else ""
    share = "" if effect.gap_closed is None else f"closes {interval(effect.gap_closed)} of the gap"
    return ", ".join(filter(None, (share, falls)))


def _step_name(effect: Finding) -> str:
    return f"+ {label(effect.name)}{' by the force alone' if is_hidden(effect) else ''}"


def percent(fraction: float) -> str:
    """``0.914`` as ``91 %``; what would round to 0 or 100 % has more digits, or is a bound."""
    if not math.isfinite(100 * fraction):
        return NOTHING
    fraction = round(fraction, 9)  # a sum of shares is 1 up to rounding
    for digits in (0, 1):
        if not 0 < fraction < 1 or 0 < float(f"{100 * fraction:.{digits}f}") < 100:
            return signed(f"{100 * fraction:.{digits}f} %")
    return "> 99.9 %" if fraction > 0.5 else "< 0.1 %"


def interval(closed: GapClosed | None) -> str:
    """``91 % (88 to 93 %)``; without the interval where its ends are equal to a tenth of a per cent."""
    if closed is None or not math.isfinite(closed.fraction):
        return NOTHING
    for digits in (0, 1):
        low, high = (signed(f"{100 * q:.{digits}f}") for q in (closed.q05, closed.q95))
        if low != high:
            mean = percent(closed.fraction)
            if digits and closed.q05 <= closed.fraction <= closed.q95:  # as many digits as its ends
                mean = signed(f"{100 * closed.fraction:.{digits}f} %")
            return f"{mean} ({low} to {high} %)"
    return percent(closed.fraction)


def kilowatts(watts: float | None) -> str:
    """``14.2 kW``; two digits below 1 kW: ``0.22 kW``, ``0.096 kW``."""
    if watts is None or not math.isfinite(watts):
        return NOTHING
    decimals = 1 if abs(watts) >= 1e3 else 2 if abs(watts) >= 1e2 else 3
    return signed(f"{watts / 1e3:.{decimals}f} kW")


def size(magnitude: Magnitude) -> str:
    """``wind 6.12 ± 0.41 m/s``."""
    if not math.isfinite(magnitude.value):
        return NOTHING
    return f"{_quantity(magnitude)} {_value(magnitude)}"


def bayes(x: float | None) -> str:
    """A log Bayes factor: one decimal, none where it is large."""
    if x is None or not math.isfinite(x):
        return NOTHING
    return signed(f"{x:+.1f}" if abs(x) < 10 else f"{x:+,.0f}")


def shift(change: Shift | None, sd: Shift | None = None) -> str:
    """``mass +120 kg, A -35 N, C +0.104``, as far as the first digit of the ``sd``; C without its unit."""
    if change is None:
        return NOTHING
    values, doubts = (change.mass, change.A, change.C), (0.0,) * 3 if sd is None else (sd.mass, sd.A, sd.C)
    parts = [
        f"{name} {_change(value, step, doubt)} {unit if name != 'C' else ''}".strip()
        for value, doubt, (name, unit, step) in zip(values, doubts, PARAMETERS, strict=True)
    ]
    return ", ".join(part for part in parts if any(digit in part for digit in "123456789")) or "nothing worth showing"


def road_load(values: Shift, sd: Shift | None) -> str:
    """``mass 24,100 ± 120 kg, A 1,240 ± 60 N, C 3.680 ± 0.150``, C without its unit."""
    doubts = (math.nan,) * 3 if sd is None else (sd.mass, sd.A, sd.C)
    return ", ".join(
        f"{name} {parameter_with_sd(value, doubt, step)} {unit if name != 'C' else ''}".strip()
        for value, doubt, (name, unit, step) in zip((values.mass, values.A, values.C), doubts, PARAMETERS, strict=True)
    )


def parameter_with_sd(value: float, sd: float, step: float) -> str:
    """A road-load parameter and its standard deviation, to the step worth showing."""
    return parameter(value, step) + (f" ± {parameter(sd, step)}" if math.isfinite(sd) else "")


def _change(value: float, step: float, sd: float) -> str:
    if not (math.isfinite(value) and step < sd < math.inf):
        return parameter(value, step, "+")
    decimals = -exponent(sd)
    return signed(f"{round(value, decimals):+,.{max(decimals, 0)}f}")


def parameter(value: float, step: float, sign: str = "") -> str:
    """A road-load parameter to the step worth showing."""
    return signed(f"{value:{sign},.{0 if step >= 1 else 3}f}") if math.isfinite(value) else NOTHING


def times(spans: tuple[Span, ...], several: bool = False) -> str:
    """``0:12:30 to 0:14:05``, at most three of them, of ``several`` logs with their number; empty for always."""
    if not spans:
        return ""
    parts = []
    for i, (start, end, log) in enumerate(spans[:MAX_SPANS]):
        named = several and (i == 0 or log != spans[i - 1].log)
        parts.append(f"{f'log {log + 1} ' if named else ''}{clock(start)} to {clock(end)}")
    return ", ".join(parts) + (f" and {len(spans) - MAX_SPANS} more" if len(spans) > MAX_SPANS else "")


def action(finding: Finding, several: bool = False) -> str:
    """How and when an effect acts, as far as the log, or ``several``, show it."""
    return "; ".join(filter(None, (finding.detail, times(finding.span, several)))) or NOTHING


def of_the_longest(d: Diagnosis) -> str:
    """Which of several drives the parameters are of; empty for the only one."""
    return "" if d.longest is None else f"of the drive with most usable driving, {times((d.longest,), len(d.logs) > 1)}"


def logs(d: Diagnosis) -> str:
    """Their names, numbered where there are several: times refer to a log by its number."""
    if len(d.logs) < 2:
        return "".join(d.logs)
    return ", ".join(f"log {i}: {name}" for i, name in enumerate(d.logs, start=1))


def listed(names: list[str]) -> str:
    """``a, b and c``."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) if names else ""


def _quantity(magnitude: Magnitude) -> str:
    """Name of what a magnitude states; slopes that signals show are stated by their standard deviation too."""
    return HIDDEN_GRADE if magnitude.name == SHOWN_SLOPE else label(magnitude.name)


def _value(magnitude: Magnitude) -> str:
    return number_format.with_sd(magnitude.value, magnitude.sd, magnitude.unit)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
