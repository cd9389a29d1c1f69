"""Explanation of the drives: the most probable hypothesis, a set of effects and processes, and the kind of road.

The search runs with a level road and, if there is evidence of slopes, with the road as a state; the result with more
evidence is the explanation. By the force alone, an unmodelled force can look like slopes. So slopes that are too small
for a road, or that signals of the road contradict, are not hills.
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
    """The drives with the hypothesis that explains them.

    ``slopes``: log Bayes factor of a sloping road over a level one; None if the configuration gives the road.
    """

    explained: Explained
    is_sloping: bool  # the road is a state in the model
    slopes: float | None
    is_hilly: bool  # the slopes are those of a road

    @property
    def which(self) -> int:
        """Number of the drive with most strides; results that hold for a single drive are taken from it."""
        drives = self.explained.drives
        return max(range(len(drives)), key=lambda i: len(drives[i].fit.strides))

    @property
    def longest(self) -> DriveState:
        """The drive with most strides."""
        return self.explained.drives[self.which]


def started(cases: Sequence[Case]) -> tuple[tuple[Case, ...], tuple[DriveState, ...]]:
    """The cases whose motion can be fitted, and their fits: on a level road unless the road is given."""
    fitted = [(case, case.state(is_level=not case.is_road_given)) for case in cases]
    states = tuple(state for _, state in fitted if state is not None)
    return tuple(case for case, state in fitted if state is not None), states


def explain(
    cases: Sequence[Case], plain: tuple[DriveState, ...], effects: Sequence[Effect], thresholds: Thresholds
) -> Explanation:
    """Search for the effects and processes that act on the drives of ``cases``; ``plain``: their fits by `started`."""
    present = {effect_term.effect.name for case in cases for effect_term in case.terms}
    candidates = [e for e in effects if not (e.is_absorbed or e.is_gravity or e.name in present)]
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
    """The explanation with more evidence, on a level road or on a sloping one, of drives that seem to have slopes.

    ``level``: the result on a level road, if it is known. Over hills the search on a level road takes many rounds to
    explain the slopes by effects, so it is second.
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
    """Log Bayes factor of a sloping road over a level one, with the effects of each drive's fit in both models.

    ``sloping``: fits of the same drives with slopes; their scales are the start of the search for scales.
    """
    known = [drive.fit.scales for drive in sloping] if sloping else [None for _ in drives]
    pairs = zip(drives, known, strict=True)
    return sum(log_bayes_factor_of_road(drive.strides, drive.fit, scales) for drive, scales in pairs)


def _is_shown(explained: Explained, thresholds: Thresholds) -> bool | None:
    """True if signals of the road confirm the slopes that the force shows, False if they contradict them, else None."""
    signals = sum(log_bayes_factor_of_signals(d.strides, d.fit) for d in explained.drives if d.fit.scales.readings)
    return None if abs(signals) < thresholds.min_log_bf_signals else bool(signals > 0)
