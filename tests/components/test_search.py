"""The rules of the search: when its rounds end, which times are candidates, and which road explains the drives."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_strides import made_strides
from numpy.testing import assert_allclose

from estimator.components import search
from estimator.components.candidate_terms import CandidateTerms, EarlierTerms
from estimator.components.drive_state import DriveState
from estimator.components.hypothesis_space import HypothesisSpace
from estimator.components.model_table import Hypothesis, ModelTable
from estimator.components.search import Search
from estimator.components.search_result import SearchResult
from estimator.components.switching import Switching
from estimator.components.term import Frame, term_of
from estimator.diagnosis import road_comparison
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_fit import MAX_RELATIVE_SD
from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import BY_NAME
from estimator.model.road import LEVEL, RoadModel
from estimator.model.road_scales import POWER, SCALES, TORQUE
from estimator.model.spans import Spans, covered
from estimator.signals import Quantity

Round = tuple[tuple[int, ...], float]  # the best set of a table, and its log evidence with scales of its own


IMPOSSIBLE = 9  # a term whose magnitude is beyond its limit once the scales are refitted


def state(log_evidence: float, chosen: tuple[int, ...] = (), **further: Any) -> Any:
    beyond = {"impossible"} if IMPOSSIBLE in chosen else set[str]()
    drive = SimpleNamespace(
        log_evidence=log_evidence,
        chosen=(),
        hypothesis=chosen,
        magnitudes=np.empty(0),
        stretches=None,
        beyond_limits=lambda given: beyond,
        fit=SimpleNamespace(determines_mass=True),
        **{"has_unusual_noise": False, "is_road_hidden": False} | further,
    )
    drive.bare = lambda: drive
    return drive


def rounds(
    monkeypatch: pytest.MonkeyPatch,
    script: Sequence[Round],
    started: list[Any] | None = None,
    *,
    sizes: list[int] | None = None,
    above: float | None = None,
    stays_unusual: bool = False,
    **start: Any,
) -> float:
    """Log evidence of the drives that a search ends with, whose tables go by ``script``; ``start``: of its drive.

    The drive that each round starts from is added to ``started``, and how many terms its hypotheses may have to
    ``sizes``. With ``above``, the search is first cut off because it will not come to so much.
    """
    waiting, sizes = iter(script), [] if sizes is None else sizes

    class Scripted:
        def __init__(self, drives: tuple[Any, ...], *arguments: object) -> None:
            self.drives, (self.chosen, self.value) = drives, next(waiting)
            if started is not None:
                started.extend(drives)

        def groups(self) -> list[object]:
            return []

        def fitted(self, chosen: object) -> tuple[Any, ...]:
            return (state(self.value, self.chosen, has_unusual_noise=stays_unusual),)

        def fitted_hypothesis(self) -> tuple[int, ...]:
            return tuple(self.drives[0].hypothesis)

        def log_prior(self, chosen: object, groups: object) -> float:
            return 0.0

        def without_small_gains(self, chosen: tuple[int, ...]) -> tuple[int, ...]:
            return chosen

        def rivals(self, table: object) -> tuple[()]:
            return ()

    def scripted(space: Scripted, groups: object, max_terms: int, starts: object) -> object:
        sizes.append(max_terms)
        return SimpleNamespace(best=space.chosen)

    monkeypatch.setattr(search, "HypothesisSpace", Scripted)
    monkeypatch.setattr(search, "weigh", scripted)
    tried = Search((state(0.0, **start),), ())
    assert above is None or tried.result_above(above) is None
    (found,) = tried.effects_only
    assert not list(waiting)
    return float(found.log_evidence)


def test_a_set_with_less_evidence_by_its_own_scales_ends_the_rounds(monkeypatch):
    assert rounds(monkeypatch, [((1, 2), 30.0), ((1, 3, 4), 20.0)]) == 30.0


def test_rounds_go_on_while_the_evidence_grows(monkeypatch):
    assert rounds(monkeypatch, [((1, 2), 30.0), ((1, 2, 3), 33.2), ((1, 2, 3), 37.0), ((1, 2, 3), 37.3)]) == 37.3


def test_rounds_end_with_one_that_hardly_gains(monkeypatch):
    assert rounds(monkeypatch, [((1,), 30.0), ((1, 2), 30.5)]) == 30.5


def test_a_set_whose_sizes_become_impossible_is_no_measure_for_the_next_one(monkeypatch):
    script = [((1,), 10.0), ((1, IMPOSSIBLE), 30.0), ((1, 2), 20.0), ((1, 2), 20.2)]
    assert rounds(monkeypatch, script) == 20.2


def test_rounds_do_not_go_from_an_impossible_set_to_the_one_before_it_and_back(monkeypatch):
    script = [((1,), 10.0), ((IMPOSSIBLE,), 30.0), ((1,), 10.1)]
    assert rounds(monkeypatch, script) == 10.1


def test_a_set_that_is_possible_is_kept_where_only_impossible_ones_have_more_evidence(monkeypatch):
    assert rounds(monkeypatch, [((1, 2), 10.0), ((1, 2, IMPOSSIBLE), 30.0), ((1, 3), 5.0)]) == 10.0


def test_rounds_end_where_an_impossible_set_comes_again_with_the_same_evidence(monkeypatch):
    script = [((1,), 10.0), ((1, IMPOSSIBLE), 30.0), ((1, IMPOSSIBLE), 30.2)]
    assert rounds(monkeypatch, script) == 10.0


def test_rounds_end_where_an_impossible_set_is_less_probable_than_one_before_it(monkeypatch):
    script = [((1, IMPOSSIBLE), 30.0), ((1, IMPOSSIBLE), 20.0), ((1,), 10.0), ((1,), 10.2)]
    assert rounds(monkeypatch, script) == 10.2


def test_rounds_go_on_while_the_evidence_of_impossible_sets_grows(monkeypatch):
    script = [((1,), 10.0), ((1, IMPOSSIBLE), 30.0), ((1, 2, IMPOSSIBLE), 34.0), ((1, 2, 3), 25.0), ((1,), 24.0)]
    assert rounds(monkeypatch, script) == 25.0


def test_a_search_that_was_cut_off_goes_on_where_it_stopped(monkeypatch):
    started = list[Any]()
    script = [((1,), 10.0), ((1, 2), 20.0), ((1, 2), 20.2)]
    assert rounds(monkeypatch, script, started, above=1000.0) == 20.2
    assert [drive.hypothesis for drive in started] == [(), (1,), (1, 2)]


def test_a_search_that_was_cut_off_with_an_impossible_set_starts_again(monkeypatch):
    started = list[Any]()
    script = [((IMPOSSIBLE,), 10.0), ((1, 2), 20.0), ((1, 2), 20.2)]
    assert rounds(monkeypatch, script, started, above=1000.0) == 20.2
    assert [drive.hypothesis for drive in started] == [(), (), (1, 2)]


def test_hypotheses_have_up_to_one_term_more_than_act_two_at_first(monkeypatch):
    sizes = list[int]()
    rounds_of = [((1, 2), 30.0), ((1, 2, 3), 40.0), ((1, 2, 3, 4, 5), 50.0), ((1, 2, 3, 4, 5), 50.2)]
    assert rounds(monkeypatch, rounds_of, sizes=sizes) == 50.2
    assert sizes == [2, 3, 4, 5]


def test_where_all_sets_are_impossible_the_search_starts_again_without_their_effects(monkeypatch):
    script = [((IMPOSSIBLE,), 30.0), ((IMPOSSIBLE,), 30.2), ((1,), 10.0), ((1,), 10.2)]
    assert rounds(monkeypatch, script) == 10.2


def test_where_noise_is_unusual_effects_are_searched_from_the_usual_noise(monkeypatch):
    usual, started = state(-50.0), list[Any]()
    script = [((1,), 29.5), ((1,), 30.0)]
    found = rounds(monkeypatch, script, started, has_unusual_noise=True, with_usual_noise=lambda: usual)
    assert (found, started[0] is usual) == (30.0, True)


@pytest.mark.parametrize(("from_its_own_noise", "best"), [(40.0, 40.0), (20.0, 30.0)])
def test_where_noise_stays_unusual_effects_are_searched_from_that_of_the_drive_too(
    monkeypatch, from_its_own_noise, best
):
    script = [((1,), 29.5), ((1,), 30.0), ((2,), from_its_own_noise - 0.5), ((2,), from_its_own_noise)]
    unusual: dict[str, Any] = {"has_unusual_noise": True, "with_usual_noise": lambda: state(-50.0)}
    assert rounds(monkeypatch, script, stays_unusual=True, **unusual) == best


def test_where_noise_is_usual_effects_are_searched_from_the_noise_of_the_drive(monkeypatch):
    started = list[Any]()
    rounds(monkeypatch, [((1,), 29.5), ((1,), 30.0)], started)
    assert started[0].log_evidence == 0.0


# Times


def driven(n: int = 400) -> DriveState:
    rng = np.random.default_rng(4)
    speed = 15 + 4 * np.sin(np.arange(n + 1) / 15)
    force = 20e3 * np.diff(speed) + 2e3 + rng.normal(0, 100.0, n)
    context = {Quantity.ELAPSED: np.arange(n) + 0.5, Quantity.STOPS: np.zeros(n)}
    found = DriveState.of(made_strides(speed, force, context), is_level=True)
    assert found is not None
    return found


def test_what_times_of_another_effect_hold_is_added_to_the_times_of_a_chosen_one_and_taken_away(monkeypatch):
    brake, own, other = BY_NAME["brake_use"], ((50.0, 80.0), (200.0, 230.0)), ((70.0, 90.0),)
    plain = driven()
    chosen = plain.with_terms((term_of(Frame.of(plain.fit), EffectTerm(brake, None, own), 1.0),))
    monkeypatch.setattr(Switching, "proposed", lambda self, effect: {other})
    candidates = CandidateTerms([brake, BY_NAME["auxiliary_cycling"]], [()], EarlierTerms())

    def times(drive: DriveState, name: str) -> set[Spans | None]:
        tried = candidates.on_drive(0, drive, with_processes=False, with_stretches=False)
        return {candidate.term.spans for candidate in tried if candidate.term.name == name}

    assert times(plain, "brake_use") == {other}
    with_other, without_other = ((50.0, 90.0), (200.0, 230.0)), ((50.0, 70.0), (200.0, 230.0))
    assert times(chosen, "brake_use") == {own, other, with_other, without_other}
    assert times(chosen, "auxiliary_cycling") == {own, other}


def test_times_that_passed_between_two_effects_make_a_hypothesis(monkeypatch):
    brake, fan, plain = BY_NAME["brake_use"], BY_NAME["auxiliary_cycling"], driven()
    held = {brake: ((50.0, 80.0),), fan: ((110.0, 150.0), (200.0, 230.0))}
    passed = {brake.name: ((50.0, 80.0), (110.0, 150.0)), fan.name: ((200.0, 230.0),)}
    frame = Frame.of(plain.fit)
    chosen = plain.with_terms(
        tuple(term_of(frame, EffectTerm(effect, None, spans), 1.0) for effect, spans in held.items())
    )
    monkeypatch.setattr(Switching, "proposed", lambda self, effect: set())
    monkeypatch.setattr(Switching, "best_pair", lambda self, effects: passed)
    candidates = CandidateTerms([brake, fan], [()], EarlierTerms())
    space = HypothesisSpace((chosen,), [()], [candidates.on_drive(0, chosen, False, False)])
    fitted = space.fitted_hypothesis()

    def times(hypothesis: Hypothesis | None) -> dict[object, object]:
        assert hypothesis is not None
        return {space.keys[i][0]: space.keys[i][2] for i in hypothesis}

    assert candidates.pairs == {0: [passed]}
    assert times(fitted) == {effect.name: spans for effect, spans in held.items()}
    assert times(space.with_times(fitted, 0, passed)) == passed
    assert times(space.with_times(fitted, 0, {fan.name: ()})) == {brake.name: held[brake]}
    assert space.with_times(fitted, 0, {fan.name: ((1.0, 30.0),)}) is None


@pytest.mark.slow
def test_a_brake_gets_the_times_that_a_fan_held_in_one_round(monkeypatch):
    """Either change alone lowers the evidence, so that no step of the table by itself makes it."""
    brake, fan = BY_NAME["brake_use"], BY_NAME["auxiliary_cycling"]
    of_brake, of_fan = ((200.0, 225.0), (520.0, 538.0), (860.0, 885.0)), ((1100.0, 1290.0),)
    t = np.arange(1500) + 0.5
    speed = 15 + 4 * np.sin(np.arange(1501) / 15)
    force = 20e3 * np.diff(speed) + 2e3 + np.random.default_rng(4).normal(0, 100.0, len(t))
    force += 5e3 * covered(t, 1.0, of_brake) + 60e3 * covered(t, 1.0, of_fan) / (0.5 * (speed[1:] + speed[:-1]))
    plain = DriveState.of(made_strides(speed, force, {Quantity.ELAPSED: t, Quantity.STOPS: 0.0 * t}), is_level=True)
    assert plain is not None
    terms = EffectTerm(brake, None, of_brake[:1]), EffectTerm(fan, None, (*of_brake[1:], *of_fan))
    held = plain.with_terms(tuple(term_of(Frame.of(plain.fit), term, 1.0) for term in terms))
    monkeypatch.setattr(Switching, "proposed", lambda self, effect: set())  # those of the pair are left

    def chosen_times() -> dict[str, Spans | None]:
        latest = Search((plain,), [brake, fan])._round((held,), False, False)
        return {term.name: term.spans for term in latest.states[0].chosen}

    times = chosen_times()
    assert_allclose(times[brake.name], of_brake, atol=1.0)
    assert_allclose(times[fan.name], of_fan, atol=1.0)
    monkeypatch.setattr(Search, "_with_best_pairs", lambda self, space, fitted: [])
    assert chosen_times() != times


def test_what_one_search_found_is_tried_by_the_next_from_its_first_round_on(monkeypatch):
    loss, brake, fan = (BY_NAME[name] for name in ("cold_loss", "brake_use", "auxiliary_cycling"))
    plain, shape, own = driven(), BY_NAME["cold_loss"].shapes[1], ((50.0, 80.0), (200.0, 230.0))
    frame, earlier_terms = Frame.of(plain.fit), EarlierTerms()
    before = plain.with_terms(
        (term_of(frame, EffectTerm(brake, None, own), 1.0), term_of(frame, EffectTerm(loss, shape)))
    )
    earlier_terms.add_drive(0, before)
    monkeypatch.setattr(Switching, "proposed", lambda self, effect: set())

    def tried(earlier_terms: EarlierTerms) -> set[tuple[str, object]]:
        candidates = CandidateTerms([loss, brake, fan], [()], earlier_terms)
        on_drive = candidates.on_drive(0, plain, with_processes=False, with_stretches=False)
        return {(candidate.term.name, candidate.key) for candidate in on_drive}

    finer = {(loss.name, str(time)) for time in loss.finer_shapes(shape, float(before.magnitudes[1]))}
    on_the_grid = {(loss.name, str(time)) for time in loss.shapes}
    assert tried(earlier_terms) - tried(EarlierTerms()) == {(brake.name, own), (fan.name, own)} | finer - on_the_grid


# Shapes


def test_a_rival_of_what_was_chosen_has_shapes_between_those_of_the_grid_too():
    """Else what happened to be chosen first would have more evidence by its finer shapes alone."""
    loss, plain, earlier_terms = BY_NAME["cold_loss"], driven(), EarlierTerms()
    candidates = CandidateTerms([loss, BY_NAME["viscous_drag"]], [()], earlier_terms)

    def joined() -> HypothesisSpace:
        return HypothesisSpace(
            (plain,), [()], [candidates.on_drive(0, plain, with_processes=False, with_stretches=False)]
        )

    def numbers(space: HypothesisSpace) -> dict[object, int]:
        return {key[-1]: i for i, key in enumerate(space.keys) if key[0] == loss.name}

    space = joined()
    drag = [key[0] for key in space.keys].index("viscous_drag")
    assert set(numbers(space)) == {str(time) for time in loss.shapes}
    sets = (drag,), tuple(sorted((drag, numbers(space)[str(loss.shapes[1])]))), (numbers(space)[str(loss.shapes[0])],)
    table = ModelTable(sets, np.array([0.9, 0.08, 0.02]), 0.0)
    ((number, effect_term, size),) = space.rivals(table)
    both = [term_of(Frame.of(plain.fit), each) for each in (EffectTerm(BY_NAME["viscous_drag"]), effect_term)]
    assert (number, effect_term.shape) == (0, loss.shapes[1])
    assert size == pytest.approx(plain.joint_with(both).posterior([0, 1]).mean[-1])

    earlier_terms.add_effect_term(number, effect_term, size)
    near = {str(time) for time in loss.finer_shapes(effect_term.shape, size)}
    assert set(numbers(joined())) == {str(time) for time in loss.shapes} | near


def test_a_search_makes_the_shapes_of_rivals_finer(monkeypatch):
    tried: list[set[object]] = []
    within = CandidateTerms.on_drive

    def watched(self: CandidateTerms, *arguments: Any) -> Any:
        found = list(within(self, *arguments))
        tried.append({candidate.key for candidate in found if candidate.term.name == loss.name})
        return found

    loss, t = BY_NAME["cold_loss"], np.arange(1500) + 0.5
    speed = 15 + 5 * np.sin(2 * np.pi * np.arange(1501) / 90) + 2 * np.sin(2 * np.pi * np.arange(1501) / 37)
    v = 0.5 * (speed[1:] + speed[:-1])
    force = 20e3 * np.diff(speed) + 1500 + 40 * v + 3 * v**2 + np.random.default_rng(3).normal(0, 100.0, 1500)
    context = {Quantity.ELAPSED: t, Quantity.STOPS: np.zeros(1500)}
    start = DriveState.of(made_strides(speed, force, context), is_level=True)
    assert start is not None
    monkeypatch.setattr(CandidateTerms, "on_drive", watched)
    (found,) = Search((start,), [loss, BY_NAME["viscous_drag"]]).effects_only
    assert [term.name for term in found.chosen] == ["viscous_drag"]
    assert tried[0] == {str(time) for time in loss.shapes}
    assert any(tried[-1] >= {str(time) for time in loss.finer_shapes(shape, 0.0)} for shape in loss.shapes)


# Rivals


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        ([0.5, 0.44, 0.06, 0.0, 0.0], ("b", 0.94)),
        ([0.86, 0.06, 0.02, 0.0, 0.06], ("", 0.86)),  # without a, b acts in less than half of the probability
        ([0.5, 0.05, 0.1, 0.35, 0.0], ("", 0.85)),  # b acts as often beside a: it is not in its place
        ([0.5, 0.0, 0.2, 0.0, 0.3], ("c", 0.8)),
    ],
)
def test_a_rival_acts_more_likely_than_not_where_an_effect_does_not(probability, expected):
    """Sets: a; b; nothing; a and b; c."""
    table = ModelTable(((0,), (1, 2), (), (0, 2), (3,)), np.array(probability), 0.0)
    rival, either = table.rival([0], {"b": [1, 2], "c": [3]})
    assert (rival, either) == (expected[0], pytest.approx(expected[1]))
    assert table.rival([0], {}) == ("", pytest.approx(probability[0] + probability[3]))


def test_rounding_makes_no_probability_larger_than_one():
    """Weights of sets are exponentials of differences of large numbers, whose sum is one to some 1e-14."""
    table = ModelTable(((0,), (1,)), np.array([0.75, 0.25 + 4e-14]), 0.0)
    assert (table.probability_of_any([0, 1]), table.probability_of_none) == (1.0, 0.0)


# The noise to start from


def test_a_force_that_comes_and_goes_is_unusual_noise_of_a_drive_that_can_start_from_the_usual():
    n, rng = 600, np.random.default_rng(5)
    speed = 15 + 4 * np.sin(np.arange(n + 1) / 15)
    brake = 9e3 * ((np.arange(n) % 90 > 50) & (np.arange(n) % 90 < 65))
    force = 20e3 * np.diff(speed) + 2e3 + brake + rng.normal(0, 100.0, n)
    noisy = DriveState.of(made_strides(speed, force, {}), is_level=True)
    assert noisy is not None
    assert not driven().has_unusual_noise
    assert noisy.has_unusual_noise
    quiet = noisy.with_usual_noise()
    assert not quiet.has_unusual_noise
    assert quiet.is_level
    likelihood = Likelihood(RoadModel(noisy.strides, LEVEL), (), quiet.fit.theta[:ROAD_LOAD], quiet.fit.scales.lag)
    assert quiet.fit.log_evidence == pytest.approx(likelihood.log_evidence(quiet.fit.scales.values), rel=0.01)
    assert quiet.fit.log_evidence < noisy.fit.log_evidence


@pytest.mark.slow
def test_a_load_that_comes_and_goes_is_found_though_noise_that_lasts_long_holds_it():
    n, rng = 1500, np.random.default_rng(4)
    speed = 15 + 4 * np.sin(np.arange(n + 1) / 15) + np.cumsum(rng.normal(0, 0.02, n + 1))
    begins = np.cumsum(rng.uniform(45.0, 120.0, 18))
    spans = tuple(zip(begins.tolist(), (begins + rng.uniform(8.0, 22.0, 18)).tolist(), strict=True))
    load = 4e3 * covered(np.arange(n) + 0.5, 1.0, spans) / (0.5 * (speed[1:] + speed[:-1]))
    force = 20e3 * np.diff(speed) + 2e3 + load + rng.normal(0, 60.0, n)
    noisy = DriveState.of(made_strides(speed + rng.normal(0, 0.01, n + 1), force, {}), is_level=True)
    assert noisy is not None
    sizes = noisy.fit.scales.values[[TORQUE, POWER]]
    assert np.all(sizes < [SCALES[i].centre * np.exp(SCALES[i].spread) for i in (TORQUE, POWER)])
    assert noisy.has_unusual_noise  # by its time
    (found,) = Search((noisy,), [BY_NAME["auxiliary_cycling"]]).effects_only
    assert [term.name for term in found.chosen] == ["auxiliary_cycling"]
    assert found.magnitudes[0] == pytest.approx(4e3, rel=0.15)


def test_a_size_beyond_its_limit_is_impossible_but_for_effects_that_are_given():
    n, spans = 600, ((100.0, 200.0), (300.0, 400.0))
    speed = 15 + 4 * np.sin(np.arange(n + 1) / 15)
    fan = 150e3 * covered(np.arange(n) + 0.5, 1.0, spans) / (0.5 * (speed[1:] + speed[:-1]))
    force = 20e3 * np.diff(speed) + 2e3 + fan + np.random.default_rng(6).normal(0, 100.0, n)
    plain = DriveState.of(made_strides(speed, force, {}), is_level=True)
    assert plain is not None
    state = plain.with_terms((term_of(Frame.of(plain.fit), EffectTerm(BY_NAME["auxiliary_cycling"], None, spans)),))
    assert state.beyond_limits(0) == {"auxiliary_cycling"}
    assert not state.beyond_limits(1)
    assert not plain.beyond_limits(0)
    (found,) = Search((plain,), [BY_NAME["auxiliary_cycling"]]).effects_only
    assert not found.chosen


def test_an_effect_that_leaves_the_mass_undetermined_is_impossible():
    plain = driven()
    mass_step = term_of(Frame.of(plain.fit), EffectTerm(BY_NAME["mass_step"], None, ((0.0, 200.0),)))
    load = term_of(Frame.of(plain.fit), EffectTerm(BY_NAME["auxiliary_load"], None))
    state = plain.with_terms((load, mass_step))
    search = Search((plain,), [])
    assert not search._impossible((state,))
    shared = np.zeros(len(state.fit.beta))
    shared[[0, -1]] = MAX_RELATIVE_SD * state.fit.beta[0]  # of 1/m and the step together
    blurred = replace(state, fit=replace(state.fit, covariance=state.fit.covariance + np.outer(shared, shared)))
    assert search._impossible((blurred,)) == {"mass_step"}
    assert Search((replace(plain, fit=blurred.fit),), [])._impossible((blurred,)) == set()  # nor is it without
    assert not blurred.nearest_to_mass(2)


# The road


def found_on_either_road(
    monkeypatch: pytest.MonkeyPatch,
    level: float,
    signals: float | None = None,
    plain: float = -np.inf,
    slopes: Sequence[float] = (50.0,),
) -> tuple[SearchResult, list[str]]:
    """Result of a search whose drives have a log posterior of 100 beside slopes and ``level`` without, and its order.

    ``plain``: log evidence beside slopes without effects; ``slopes``: their log Bayes factors, one after the other, of
    which the last holds from then on.
    """
    scales = SimpleNamespace(readings=() if signals is None else ("altitude",))
    fit = SimpleNamespace(strides=np.zeros(9), scales=scales, terms=("an effect",))
    drive: Any = SimpleNamespace(fit=fit, strides=None, slope_sd=0.01)
    unknown: dict[str, Any] = dict.fromkeys(SearchResult.__dataclass_fields__)
    values, order = list(slopes), list[str]()

    class Found:
        def __init__(self, drives: tuple[Any, ...], effects: object, earlier_terms: object) -> None:
            self.road, self.effects_only = drives[0].road, (drive,)

        def result(self) -> SearchResult:
            order.append(self.road)
            log_posterior = 100.0 if self.road == "sloping" else level
            return SearchResult(**(unknown | {"drives": (drive,), "log_posterior": log_posterior}))

        def result_above(self, min_log_posterior: float) -> SearchResult | None:
            return self.result() if level > min_log_posterior else None

    monkeypatch.setattr(road_comparison, "Search", Found)
    monkeypatch.setattr(
        road_comparison, "_slopes", lambda states, sloping=(): values.pop(0) if values[1:] else values[0]
    )
    monkeypatch.setattr(road_comparison, "log_bayes_factor_of_signals", lambda strides, fit, starts: signals)
    starts = {road: SimpleNamespace(fit=fit, road=road, log_evidence=plain) for road in ("level", "sloping")}
    case = SimpleNamespace(
        terms=(), is_road_given=False, state=lambda is_level: starts["level" if is_level else "sloping"]
    )
    cases, states = road_comparison.fitted_cases([case])
    return road_comparison.search(cases, states, [], Thresholds()), order


@pytest.mark.parametrize(
    ("plain", "slopes", "order", "is_sloping"),
    [
        (60.0, (50.0, 3.0), ["level"], False),  # effects explain the slopes
        (60.0, (50.0, 40.0), ["level", "sloping"], True),  # slopes beside the effects of the level road
        (94.0, (50.0, 3.0), ["level"], False),  # less evidence than slopes, but not significantly
        (96.0, (50.0, 20.0), ["sloping"], True),  # less evidence than slopes without effects
        (96.0, (50.0, 3.0), ["level"], False),  # once effects are fitted beside the slopes, these are insignificant
        (0.0, (3.0, 3.0), ["level"], False),  # slopes are not tried
        (0.0, (3.0, 40.0), ["level", "sloping"], True),  # they come with the effects
    ],
)
def test_the_level_road_is_searched_while_it_may_have_more_evidence_than_slopes_without_effects(
    monkeypatch, plain, slopes, order, is_sloping
):
    found, searched = found_on_either_road(monkeypatch, 80.0, plain=plain, slopes=slopes)
    assert searched == order
    assert bool(found.is_sloping) == is_sloping


@pytest.mark.parametrize(
    ("level", "signals", "is_sloping", "is_hilly"),
    [
        (90.0, None, False, False),  # 10 less than beside slopes, which no signal confirms
        (80.0, None, True, True),
        (90.0, 0.1, False, False),  # signals that tell neither count as none
        (80.0, -0.1, True, True),
        (90.0, 40.0, True, True),  # confirmed
        (101.0, 40.0, False, False),
        (80.0, -40.0, True, False),  # denied: no hills, but not a level road without a gap either
    ],
)
def test_a_road_that_its_signals_confirm_needs_no_more_evidence_than_a_level_one(
    monkeypatch, level, signals, is_sloping, is_hilly
):
    found, _ = found_on_either_road(monkeypatch, level, signals)
    assert (bool(found.is_sloping), bool(found.is_hilly)) == (is_sloping, is_hilly)
