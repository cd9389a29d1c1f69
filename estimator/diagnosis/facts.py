"""Select facts for the sentences of a report: doubtful candidate, advice, unsettled pairs, effects to configure."""

from collections.abc import Sequence

from estimator.answers.diagnosis import Verdict
from estimator.components.search_result import SearchResult
from estimator.diagnosis.result import HIDDEN_GRADE, Advice, Finding
from estimator.model.effects import BY_NAME, Effect, Timing

MIN_RIVAL = 0.05  # probability above which an effect is a rival of the likeliest one


def doubtful(result: SearchResult, verdict: Verdict, named: Sequence[Finding]) -> str:
    """The likeliest candidate of a "cannot tell" without named effects; else empty."""
    if verdict is not Verdict.CANNOT_TELL or named or not result.probability:
        return ""
    return _likeliest(result)[0]


def _likeliest(result: SearchResult) -> list[str]:
    """Names of effects, the most probable first."""
    return sorted(result.probability, key=lambda name: -result.probability[name])


def advice(
    result: SearchResult, effects: Sequence[Effect], verdict: Verdict, named: Sequence[Finding]
) -> tuple[Advice, ...]:
    """The signal or manoeuvre that separates each effect from those that are equivalent to it on this drive."""
    unsure: list[str] = []
    if verdict is Verdict.CANNOT_TELL:
        unsure += [named[0].name, *named[0].equivalent] if named else _likeliest(result)[:1]
    elif verdict is Verdict.EFFECT:
        unsure += [other for finding in named for other in finding.equivalent]
        unsure += [finding.name for finding in named if finding.magnitude.name == HIDDEN_GRADE]
        unsure += beyond_streaming(named)
    shown_by = {effect.name: effect.shown_by for effect in effects}
    return tuple(Advice(name, shown_by[name]) for name in dict.fromkeys(unsure) if name in shown_by)


def unsettled(
    result: SearchResult, effects: Sequence[Effect], verdict: Verdict, named: Sequence[Finding]
) -> list[tuple[Effect, Effect | None]]:
    """Pairs of effects that the drive does not separate, the likelier one first; None: the alternative is no effect."""
    by_name = {effect.name: effect for effect in effects}
    pairs = [(finding.name, name) for finding in named for name in finding.equivalent]
    if named and (pairs or verdict is Verdict.EFFECT):
        return [(by_name[a], by_name[b]) for a, b in pairs if a in by_name and b in by_name]
    if verdict is not Verdict.CANNOT_TELL or not result.probability:
        return []
    best, *others = _likeliest(result)
    rivals = [by_name[name] for name in others if result.probability[name] > MIN_RIVAL]
    return [(by_name[best], rival) for rival in rivals] or [(by_name[best], None)]


def streaming_effects(named: Sequence[Finding], given: Sequence[Effect]) -> tuple[str, ...]:
    """Effects to configure for the streaming estimator: the ``given`` ones and the named ones.

    Empty if some are `beyond_streaming`, for a part of them alone may move A and C farther away.
    """
    added = [finding.name for finding in named if _is_to_add(finding)]
    if not added or beyond_streaming(named):
        return ()
    moving = [effect.name for effect in given if not effect.is_gravity]
    return tuple(dict.fromkeys((*moving, *added)))


def beyond_streaming(named: Sequence[Finding]) -> tuple[str, ...]:
    """Names of the effects that the streaming estimator cannot have, because no signal shows when they act."""
    sizes = {effect.symbol for effect in BY_NAME.values()}  # magnitudes that a configuration can hold
    return tuple(
        finding.name
        for finding in named
        if _is_to_add(finding)
        and not (BY_NAME[finding.name].is_streaming and finding.magnitude.name in sizes and not finding.span)
    )


def _is_to_add(finding: Finding) -> bool:
    """True for an effect that the streaming model lacks: it has the road, the lag and changes of the load anyway."""
    effect = BY_NAME.get(finding.name)
    return effect is not None and not (effect.is_gravity or effect.is_absorbed or effect.timing is Timing.STEP)
