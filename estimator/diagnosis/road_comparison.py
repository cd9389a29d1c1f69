"""Search for the most probable hypothesis on a level road and, where there is evidence of slopes, on a sloping one.

The result with more evidence is kept. A sloping road is a state of the model. By the force alone, an unmodelled force
can look like slopes. So slopes that are too small for a road, or that signals of the road contradict, are not hills.
"""

from collections.abc import Sequence
from dataclasses import replace

from estimator.components.candidate_terms import EarlierTerms
from estimator.components.drive_state import DriveState
from estimator.components.search import Search
from estimator.components.search_result import SearchResult, log_evidence
from estimator.diagnosis.case import Case
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_evidence import log_bayes_factor_of_road, log_bayes_factor_of_signals
from estimator.model.effects import Effect


def fitted_cases(cases: Sequence[Case]) -> tuple[tuple[Case, ...], tuple[DriveState, ...]]:
    """The cases whose motion can be fitted, and their fits: on a level road unless the road is given."""
    fits = [(case, case.state(is_level=not case.is_road_given)) for case in cases]
    states = tuple(state for _, state in fits if state is not None)
    return tuple(case for case, state in fits if state is not None), states


def search(
    cases: Sequence[Case], plain: tuple[DriveState, ...], effects: Sequence[Effect], thresholds: Thresholds
) -> SearchResult:
    """Search for the effects and processes that act on the drives of ``cases``.

    ``plain``: their fits by `fitted_cases`. Over hills, a search on a level road takes many rounds to explain them by
    effects: it goes on for as long as it may have more evidence than slopes without effects.
    """
    present = {effect_term.effect.name for case in cases for effect_term in case.terms}
    candidates = [e for e in effects if not (e.is_absorbed or e.is_gravity or e.name in present)]
    if cases[0].is_road_given:
        return replace(Search(plain, candidates).result(), is_sloping=True, is_hilly=True)
    earlier_terms = EarlierTerms()
    sloping = tuple(state for case in cases if (state := case.state(is_level=False)) is not None)
    sloping = sloping if len(sloping) == len(plain) else ()
    slopes = _slopes(plain, sloping)
    on_level, on_slopes = (Search(states, candidates, earlier_terms) for states in (plain, sloping))
    level: SearchResult | None
    if sloping and slopes >= thresholds.min_log_bf_slopes_tried:
        level = on_level.result_above(log_evidence(sloping) - thresholds.min_log_bf_slopes)
    else:
        level = on_level.result()
    if level is not None and any(drive.fit.terms for drive in level.drives):
        slopes = _slopes(level.drives, sloping)
    if level is not None and (not sloping or slopes < thresholds.min_log_bf_slopes_tried):
        return replace(level, slopes=slopes)
    return _on_either_road(plain, on_level, level, on_slopes, thresholds)


def _on_either_road(
    plain: Sequence[DriveState],
    on_level: Search,
    level: SearchResult | None,
    on_slopes: Search,
    thresholds: Thresholds,
) -> SearchResult:
    """The result with more evidence, on a level road or on a sloping one, of drives that seem to have slopes.

    ``plain``: fits on a level road. ``level``: the result on it; None if it is not expected to reach slopes without
    effects.
    """
    slopes = _slopes(on_slopes.effects_only, plain)
    if slopes < thresholds.min_log_bf_slopes:
        return replace(level or on_level.result(), slopes=slopes)
    result = on_slopes.result()
    is_shown = _is_shown(result.drives, plain, thresholds)
    min_log_posterior = result.log_posterior - (0.0 if is_shown else thresholds.min_log_bf_slopes)
    if level is not None and level.log_posterior > min_log_posterior:
        return replace(level, slopes=slopes)
    slopes = _slopes(result.drives, plain)
    slopes = slopes if level is None else min(slopes, result.log_posterior - level.log_posterior)
    steepest = max(drive.slope_sd for drive in result.drives)
    is_hilly = is_shown is not False and steepest > thresholds.min_grade_sd
    return replace(result, is_sloping=True, slopes=slopes, is_hilly=is_hilly)


def _slopes(drives: Sequence[DriveState], others: Sequence[DriveState]) -> float:
    """Log Bayes factor of a sloping road over a level one, with the effects of each drive's fit in both models.

    ``others``: fits of the same drives with the other kind of road, from whose scales its search begins; or none.
    """
    starts = [[drive.fit.scales] for drive in others] if others else [[] for _ in drives]
    pairs = zip(drives, starts, strict=True)
    return sum(log_bayes_factor_of_road(drive.strides, drive.fit, scales) for drive, scales in pairs)


def _is_shown(drives: Sequence[DriveState], plain: Sequence[DriveState], thresholds: Thresholds) -> bool | None:
    """True if signals of the road confirm the slopes that the force shows, False if they contradict them, else None."""
    signals = sum(
        log_bayes_factor_of_signals(drive.strides, drive.fit, [level.fit.scales])
        for drive, level in zip(drives, plain, strict=True)
        if drive.fit.scales.readings
    )
    return None if abs(signals) < thresholds.min_log_bf_signals else bool(signals > 0)
