"""The diagnosis in sentences, and the line of configuration to add."""

from estimator import readable
from estimator.diagnosis.findings import HIDDEN_GRADE
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.result import Finding, Invisible, Magnitude, Verdict
from estimator.diagnosis.thresholds import NAMED, NAMED_TIMED
from estimator.effects import BY_NAME
from estimator.estimation.columns import Term


def reason(outcome: Outcome, verdict: Verdict, named: tuple[Finding, ...], unseen: tuple[Invisible, ...]) -> str:
    """One or two sentences that a person can act on."""
    base, final = outcome.steps[0].rms / 1e3, outcome.steps[-1].rms / 1e3
    if verdict is Verdict.NO_GAP:
        hidden = f"; too small to see here: {', '.join(i.name for i in unseen)}" if unseen else ""
        return f"The road load describes this drive to {base:.1f} kW, and nothing systematic is left{hidden}."
    if verdict is Verdict.UNKNOWN:
        size = f"{outcome.left.variance**0.5 / 1e3:.1f} kW of {base:.1f} kW"
        return f"Something is missing that no known effect explains: {outcome.left.name}, {size}."
    if verdict is Verdict.CANNOT_TELL:
        return _doubt(outcome, named)
    if outcome.grade is not None:
        sd = 100 * named[0].magnitude.value
        seen = f"A force goes with the place like a grade of {sd:.1f} % sd, and no signal on the bus shows it"
        return f"{seen}; with one, the residual could fall from {base:.1f} to {outcome.floor**0.5 / 1e3:.1f} kW."
    if not outcome.result.chosen:
        base = named[0].rms_before / 1e3
    effects = " and ".join(f"{finding.name} ({finding.magnitude.name} {_size(finding.magnitude)})" for finding in named)
    return f"With {effects} in the model the residual falls from {base:.1f} to {final:.1f} kW."


def _doubt(outcome: Outcome, named: tuple[Finding, ...]) -> str:
    if named:
        return f"The drive shows {' or '.join([named[0].name, *named[0].equivalent])}, and cannot tell which."
    best = outcome.result.ranking[0]
    doubt = "too weak on this drive to be sure"
    if best.log_bayes_factor > (NAMED_TIMED if best.is_timed else NAMED):
        doubt = "but it does not foretell stretches of the drive that were kept from the fit"
    return f"There may be {best.name}, {doubt}."


def advice(outcome: Outcome, verdict: Verdict, named: tuple[Finding, ...]) -> tuple[str, ...]:
    """What signal or manoeuvre would tell apart what this drive does not."""
    unsure: list[str] = []
    if verdict is Verdict.CANNOT_TELL:
        unsure += [named[0].name, *named[0].equivalent] if named else [outcome.result.ranking[0].name]
    elif verdict is Verdict.EFFECT:
        unsure += [other for finding in named for other in finding.equivalent]
        unsure += [finding.name for finding in named if finding.magnitude.name == HIDDEN_GRADE]
    breaks = {effect.name: effect.breaks for effect in outcome.effects}
    return tuple(f"{name}: {breaks[name]}" for name in dict.fromkeys(unsure) if name in breaks)


def configuration(named: tuple[Finding, ...], given: tuple[Term, ...]) -> str:
    """The line that adds to the streaming model what it can take, beside what it has."""
    found = [f.name for f in named if f.name in BY_NAME and f.magnitude.name == BY_NAME[f.name].symbol and not f.span]
    names = dict.fromkeys([*(term.effect.name for term in given), *(n for n in found if BY_NAME[n].streams)])
    quoted = ", ".join(f'"{name}"' for name in names)
    return f"effects = [{quoted}]" if found and names else ""


def _size(magnitude: Magnitude) -> str:
    return readable.with_sd(magnitude.value, magnitude.sd, magnitude.unit)
