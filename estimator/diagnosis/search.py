"""Which effects: the one with most evidence first; those chosen are tried again after each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from estimator.diagnosis.hills import hidden_grade
from estimator.diagnosis.joint import Drive, Joint, pooled, ranked
from estimator.diagnosis.processes import Leftover, grains_of, leftovers
from estimator.diagnosis.thresholds import NAMED, NEXT, NEXT_TIMED
from estimator.effects import Effect
from estimator.estimation.columns import settled

LEAST, LEAST_TIMED = 0.003, 0.04  # of what the first effect took away: none has exactly its textbook form
MOST = 4  # effects that are looked for


@dataclass(frozen=True)
class Found:
    """An effect as it was chosen: among which others, and on top of what."""

    joint: Joint
    ranking: tuple[Joint, ...]
    before: tuple[Drive, ...]


@dataclass(frozen=True)
class Search:
    """Where the search ended: what was chosen, the first ranking, processes before and after, the final models."""

    chosen: tuple[Found, ...]
    ranking: tuple[Joint, ...]
    at_first: tuple[Leftover, ...]
    at_last: tuple[Leftover, ...]
    drives: tuple[Drive, ...]


def search(plain: tuple[Drive, ...], effects: Sequence[Effect]) -> Search:
    """Choose effects for the drives."""
    drives, chosen = plain, list[Found]()
    first, most = ranked(plain, effects), 0.0
    at_first = _leftovers(plain)
    if hidden_grade(first, at_first, plain) is not None:
        return Search((), first, at_first, at_first, plain)
    while len(chosen) < MOST:
        ranking = first if not chosen else ranked(drives, effects)
        if not ranking or ranking[0].log_bayes_factor < _needed(ranking[0], len(chosen)):
            break
        grown = _add(drives, ranking[0])
        taken = pooled(drives, grown).mean_square - pooled(grown, grown).mean_square
        if taken <= 0 or (chosen and taken < _share(ranking[0]) * most):
            break
        most = max(taken, most)
        chosen.append(Found(ranking[0], ranking, drives))
        drives = grown
        if len(chosen) > 1:
            chosen, drives = _exchange(plain, chosen, drives, effects)
    return Search(tuple(chosen), first, at_first, _leftovers(drives) if chosen else at_first, drives)


def _needed(joint: Joint, chosen: int) -> float:
    """Log Bayes factor that names an effect beside those already ``chosen``."""
    if not chosen:
        return NAMED
    return NEXT_TIMED if joint.best[1].term.spans is not None else NEXT


def _share(joint: Joint) -> float:
    """Of the squared residual that the largest effect takes away, what one more has to take at least."""
    return LEAST_TIMED if joint.best[1].term.spans is not None else LEAST


def _add(drives: tuple[Drive, ...], joint: Joint) -> tuple[Drive, ...]:
    grown = []
    for drive, candidate in zip(drives, joint.each, strict=True):
        if candidate is None or (joint.is_event and candidate.log_bayes_factor < NAMED):
            grown.append(drive)
        else:
            term = settled(candidate.term, drive.model.samples)
            grown.append(drive.having((*drive.model.terms, term)))
    return tuple(grown)


def _exchange(
    plain: tuple[Drive, ...], chosen: list[Found], drives: tuple[Drive, ...], effects: Sequence[Effect]
) -> tuple[list[Found], tuple[Drive, ...]]:
    """Let each effect but the newest stand once more against all others, given the rest."""
    for i, found in enumerate(chosen[:-1]):
        rest = tuple(drive.without(found.joint.name) for drive in drives)
        ranking = ranked(rest, effects)
        if not ranking or ranking[0].log_bayes_factor < NAMED:
            return [*chosen[:i], *chosen[i + 1 :]], rest
        chosen[i] = Found(ranking[0], ranking, found.before)
        drives = _add(rest, ranking[0])
    return chosen, drives


def _leftovers(drives: tuple[Drive, ...]) -> tuple[Leftover, ...]:
    """Processes over all drives: evidence adds up."""
    each = [{_kind(left): left for left in leftovers(grains_of(drive.model))} for drive in drives]
    samples = [len(drive.model.samples) for drive in drives]
    joined = []
    for name in each[0]:
        found = [left[name] for left in each if name in left]
        variance = sum(left[name].variance * n for left, n in zip(each, samples, strict=True) if name in left)
        joined.append(
            replace(
                found[0],
                log_bayes_factor=sum(left.log_bayes_factor for left in found),
                variance=variance / sum(samples),
            )
        )
    return tuple(sorted(joined, key=lambda left: -left.log_bayes_factor))


def _kind(left: Leftover) -> str:
    """Ripples of any period are one."""
    return "swings" if left.name.startswith("swings") else left.name
