"""The search for effects: the one with most evidence is added, then those chosen before are compared again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from estimator.diagnosis.add_effect import grown, merged
from estimator.diagnosis.excess_lag import excess_lag
from estimator.diagnosis.hidden_grade import hidden_grade
from estimator.diagnosis.multi_drive import Drive, Joint, pooled, ranked
from estimator.diagnosis.processes import Leftover
from estimator.diagnosis.remainders import beside_swing, remainders
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import Effect

MAX_EFFECTS = 4  # that are looked for
MAX_STEPS = 8  # of the search; some only lengthen an effect of the model


@dataclass(frozen=True, kw_only=True)
class Found:
    """A chosen effect: its ranking, the drives before it was added, and the best process before and after."""

    joint: Joint
    ranking: tuple[Joint, ...]
    before: tuple[Drive, ...]
    unnamed: float  # log Bayes factor of the best process, before
    unnamed_after: float
    is_beside: bool  # it was judged beside that process

    @property
    def margin(self) -> float:
        """Log Bayes factor of the effect, with or without a process beside it, over the best process alone."""
        if self.is_beside:
            return self.joint.log_bayes_factor
        return self.joint.log_bayes_factor + max(self.unnamed_after, 0.0) - max(self.unnamed, 0.0)


@dataclass(frozen=True)
class Step:
    """A further effect, or longer times of one in the model (no ``found``); reduction ``taken`` [W^2]."""

    found: Found | None
    taken: float
    drives: tuple[Drive, ...]
    left: tuple[Leftover, ...]


@dataclass(frozen=True, kw_only=True)
class Search:
    """The end of a search: chosen effects, the first ranking, processes at first and at last, the final models."""

    chosen: tuple[Found, ...]
    ranking: tuple[Joint, ...]
    at_first: tuple[Leftover, ...]
    at_last: tuple[Leftover, ...]
    drives: tuple[Drive, ...]


def search(plain: tuple[Drive, ...], effects: Sequence[Effect], thresholds: Thresholds) -> Search:
    """Choose effects for the drives."""
    drives, chosen = plain, list[Found]()
    first = ranked(plain, effects)
    late = [found for drive in plain if (found := excess_lag(drive, thresholds)) is not None]
    most = max((found.taken for found in late), default=0.0)
    left = at_first = remainders(plain)
    grade = hidden_grade(first, at_first, plain, thresholds)
    for _ in range(MAX_STEPS):
        rest = beside_swing(drives, left[0], thresholds)
        ranking = first if drives is rest is plain else ranked(rest, effects)
        process = left[0] if chosen or grade is None else grade
        others = len(chosen) + bool(late)
        step = None
        if process is not grade:
            step = _step(drives, ranking, process, others, most, thresholds, beside=False)
        if step is None and process.log_bayes_factor > thresholds.min_log_bf_process:
            ranking = ranked(rest, effects, process.covariances)
            step = _step(drives, ranking, process, others + 1, most, thresholds, beside=True)
        if step is None or len(chosen) == MAX_EFFECTS:
            break
        drives, left, most = step.drives, step.left, max(step.taken, most)
        if step.found is None:
            continue
        chosen.append(step.found)
        if len(chosen) > 1:
            chosen, exchanged = _exchange(plain, chosen, drives, effects, thresholds)
            if exchanged is not drives:
                drives, left = exchanged, remainders(exchanged)
    return Search(chosen=tuple(chosen), ranking=first, at_first=at_first, at_last=left, drives=drives)


def _step(
    drives: tuple[Drive, ...],
    ranking: tuple[Joint, ...],
    process: Leftover,
    others: int,
    most: float,
    thresholds: Thresholds,
    beside: bool,
) -> Step | None:
    """Add the effect with most evidence, if that is enough beside ``others`` effects."""
    if not ranking or ranking[0].log_bayes_factor < thresholds.min_log_bf(ranking[0].is_timed, others):
        return None
    bigger = grown(drives, ranking[0], thresholds)
    longer = merged(drives, ranking[0], bigger)
    if any(one is not other for one, other in zip(longer, bigger, strict=True)):
        return Step(None, 0.0, longer, remainders(longer))
    taken = pooled(drives, bigger).mean_square - pooled(bigger, bigger).mean_square
    share = thresholds.min_reduction_timed if ranking[0].is_timed else thresholds.min_reduction
    if taken <= 0 or taken < share * most:
        return None
    left = remainders(bigger)
    found = Found(
        joint=ranking[0],
        ranking=ranking,
        before=drives,
        unnamed=process.log_bayes_factor,
        unnamed_after=left[0].log_bayes_factor,
        is_beside=beside,
    )
    is_unexplained = found.unnamed_after > thresholds.min_log_bf_left_process
    least = thresholds.min_log_bf_further if is_unexplained or (others and ranking[0].is_timed) else 0.0
    return Step(found, taken, bigger, left) if found.margin >= least else None


def _exchange(
    plain: tuple[Drive, ...],
    chosen: list[Found],
    drives: tuple[Drive, ...],
    effects: Sequence[Effect],
    thresholds: Thresholds,
) -> tuple[list[Found], tuple[Drive, ...]]:
    """Rank all effects again in place of each chosen one but the newest; the best replaces it."""
    for i, found in enumerate(chosen[:-1]):
        rest = tuple(drive.without(found.joint.name) for drive in drives)
        ranking = ranked(rest, effects)
        if not ranking or ranking[0].log_bayes_factor < thresholds.min_log_bf_effect:
            return [*chosen[:i], *chosen[i + 1 :]], rest
        chosen[i] = replace(found, joint=ranking[0], ranking=ranking)
        drives = grown(rest, ranking[0], thresholds)
    return chosen, drives
