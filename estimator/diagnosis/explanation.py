"""What explains the drives: the most probable set of effects and processes, on a level road or beside its slopes.

The same search is made with a level road and, where that leaves evidence of slopes, with the road as a state; the one
with more evidence explains the drives. An unmodelled force may look like slopes to the force alone, so slopes that are
too small for a road, or that signals of the road deny, are no hills.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from estimator.components.candidates import FoundForms
from estimator.components.drive_state import DriveState
from estimator.components.explained import Explained
from estimator.components.search import Search
from estimator.diagnosis.case import Case
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_evidence import log_bayes_factor_of_road, log_bayes_factor_of_signals
from estimator.model.effects import Effect


@dataclass(frozen=True)
class Explanation:
    """The drives with what acts on them; ``slopes``: log Bayes factor of a road that is not level, None if given."""

    explained: Explained
    is_sloping: bool  # the road is a state in the model
    slopes: float | None
    is_hilly: bool  # the slopes are those of a road

    @property
    def which(self) -> int:
        """Number of the drive with most strides, which figures of a single drive are taken from."""
        drives = self.explained.drives
        return max(range(len(drives)), key=lambda i: len(drives[i].fit.strides))

    @property
    def longest(self) -> DriveState:
        """That drive."""
        return self.explained.drives[self.which]


def started(cases: Sequence[Case]) -> tuple[tuple[Case, ...], tuple[DriveState, ...]]:
    """The cases whose motion can be fitted, and that fit: on a level road, unless the road is given."""
    fitted = [(case, case.state(is_level=not case.is_road_given)) for case in cases]
    states = tuple(state for _, state in fitted if state is not None)
    return tuple(case for case, state in fitted if state is not None), states


def explain(
    cases: Sequence[Case], plain: tuple[DriveState, ...], effects: Sequence[Effect], thresholds: Thresholds
) -> Explanation:
    """Search for what acts on the drives of ``cases``, ``plain`` being as they are `started`."""
    present = {term.effect.name for case in cases for term in case.terms}
    candidates = [e for e in effects if not (e.absorbed or e.is_gravity or e.name in present)]
    if cases[0].is_road_given:
        return Explanation(Search(plain, candidates).explained(), True, None, True)
    forms = FoundForms()
    sloping = tuple(state for case in cases if (state := case.state(is_level=False)) is not None)
    sloping = sloping if len(sloping) == len(plain) else ()
    level, slopes = None, _slopes(plain, sloping)
    if slopes < thresholds.min_log_bf_slopes_tried:
        level = Search(plain, candidates, forms).explained()
        slopes = _slopes(level.drives, sloping)
    if not sloping or slopes < thresholds.min_log_bf_slopes_tried:
        return Explanation(level or Search(plain, candidates).explained(), False, slopes, False)
    return _on_either_road(plain, level, sloping, candidates, forms, thresholds)


def _on_either_road(
    plain: tuple[DriveState, ...],
    level: Explained | None,
    sloping: tuple[DriveState, ...],
    candidates: Sequence[Effect],
    forms: FoundForms,
    thresholds: Thresholds,
) -> Explanation:
    """The explanation with more evidence of drives that seem to have slopes; ``level``: that on a level road, if known.

    Over hills the search on a level road would take many rounds to explain the slopes by effects, so it comes second.
    """
    search = Search(sloping, candidates, forms)
    slopes = _slopes(search.alone)
    if slopes < thresholds.min_log_bf_slopes:
        return Explanation(level or Search(plain, candidates, forms).explained(), False, slopes, False)
    beside = search.explained()
    is_shown = _is_shown(beside, thresholds)
    least = beside.log_posterior - (0.0 if is_shown else thresholds.min_log_bf_slopes)
    level = level or Search(plain, candidates, forms).explained_above(least)
    if level is not None and level.log_posterior > least:
        return Explanation(level, False, slopes, False)
    slopes = min([_slopes(beside.drives), *([beside.log_posterior - level.log_posterior] if level else [])])
    steepest = max(drive.slope_sd for drive in beside.drives)
    return Explanation(beside, True, slopes, is_shown is not False and steepest > thresholds.min_grade_sd)


def _slopes(drives: Sequence[DriveState], sloping: Sequence[DriveState] = ()) -> float:
    """Log Bayes factor of a road with slopes under the drives, beside what they are fitted beside.

    ``sloping``: drives on a level road as they are with slopes.
    """
    known = [drive.fit.scales for drive in sloping] if sloping else [None for _ in drives]
    pairs = zip(drives, known, strict=True)
    return sum(log_bayes_factor_of_road(drive.strides, drive.fit, scales) for drive, scales in pairs)


def _is_shown(explained: Explained, thresholds: Thresholds) -> bool | None:
    """Whether signals of the road confirm the slopes that the force shows or deny them; None: they tell neither."""
    signals = sum(log_bayes_factor_of_signals(d.strides, d.fit) for d in explained.drives if d.fit.scales.readings)
    return None if abs(signals) < thresholds.min_log_bf_signals else bool(signals > 0)
