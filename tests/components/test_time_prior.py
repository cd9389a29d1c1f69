"""Costs of times are those of a Markov chain of two states that is seen while strides are known."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.special import logsumexp

from estimator.components.time_prior import (
    CHANGE_COST,
    DWELL_COST,
    Costs,
    cost_apart,
    cost_of_leaving,
    cost_without_dwell,
    gap_costs,
    is_usual,
    least_costs,
    observed_spans,
    prior_cost,
    probability_of_restart,
    rate_cost,
)
from estimator.model.effects import BY_NAME
from estimator.model.spans import covered

FAN, WET, BRAKE = (BY_NAME[name] for name in ("auxiliary_cycling", "resistance_segment", "brake_use"))


def test_times_cost_what_a_chain_of_two_states_makes_them_cost():
    # Beginnings come about once in exp(5.5) s, and the probability that a state ends within a second is 1/dwell, so the
    # odds of being on are dwell / exp(5.5) at any time; what the drive cuts off has no end in it.
    t = np.arange(1000.0)
    inside, first, last, whole = (100.0, 120.0), (-0.5, 20.0), (980.0, 999.5), (-0.5, 999.5)
    begins, ends = CHANGE_COST, np.log(25.0)
    assert prior_cost((inside,), FAN, t) == pytest.approx(rate_cost(1, 980.0) + begins + ends + 20 / 25)
    assert prior_cost((first,), FAN, t) == pytest.approx(rate_cost(1, 979.5) + begins + 20.5 / 200)
    assert prior_cost((last,), FAN, t) == pytest.approx(rate_cost(1, 980.5) + begins + 19.5 / 200)
    assert prior_cost((whole,), FAN, t) == pytest.approx(begins - np.log(200.0) + 1000 / 200)
    twice = rate_cost(2, 960.5) + 2 * begins + ends + 19.5 / 200 + 20 / 25
    assert prior_cost((inside, last), FAN, t) == pytest.approx(twice)
    costs = [prior_cost((span,), WET, t) for span in (inside, first, last, whole)]
    assert costs == pytest.approx([2 * np.log(1000.0), np.log(1000.0), np.log(1000.0), 0.0])


def patterns(t, spans):
    """Whether each stride at ``t`` (n,) is in one of ``spans``."""
    return covered(t, 1.0, spans) > 0.5


def exact_cost(t, spans, dwell):
    """Minus the log of the chain's density of what is seen, averaged over the rate."""
    on = patterns(t, spans)
    rates = np.linspace(0.0, 40.0, 20_001)[1:] * np.exp(-CHANGE_COST)
    share = rates / (rates + 1 / dwell)
    total = np.log(np.where(on[0], share, 1 - share))
    for before, after, gap in zip(on[:-1], on[1:], np.diff(t) - 1.0, strict=True):
        forgotten = -np.expm1(-(rates + 1 / dwell) * (gap + 1.0))
        if gap < 0.5:  # seen: a beginning or an end has a density
            change = -rates if not before else -1 / dwell
            total += (np.log(rates) if after else np.log(1 / dwell)) if before != after else change
            continue
        stays = 1 - (1 - share) * forgotten if before else share * forgotten
        total += np.log(stays if after else 1 - stays)
    weight = np.exp(CHANGE_COST - rates * np.exp(CHANGE_COST)) * (rates[1] - rates[0])
    return -logsumexp(total, b=weight)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_times_cost_what_the_chain_gives_averaged_over_its_rate(seed):
    """In traffic, to 1.5 of some 45 to 70: the cost has one rate in gaps, the exact one all."""
    rng = np.random.default_rng(seed)
    edges = np.unique(rng.integers(10, 1490, 40)).tolist()
    t = np.concatenate([np.arange(a, b) for a, b in pairwise([0, *edges, 1500])][::2]) + 0.5
    starts = np.sort(rng.choice(np.arange(20, 1460, 30), 10, replace=False)).astype(float).tolist()
    spans = tuple((start, start + float(rng.integers(4, 25))) for start in starts)
    assert len(observed_spans(spans, t)) > 2
    assert prior_cost(spans, BRAKE, t) == pytest.approx(exact_cost(t, spans, 12.0), abs=1.5)


@pytest.mark.parametrize("begins", [0, 1, 4, 30])
def test_the_cost_of_beginnings_is_averaged_over_how_often_they_come(begins):
    mean = np.exp(-CHANGE_COST)  # 1/s, of an exponential prior of the rate
    density, _ = quad(lambda x: (x * mean) ** begins * np.exp(-x * mean * 2400.0) * np.exp(-x), 0.0, np.inf)
    assert rate_cost(begins, 2400.0) == pytest.approx(-np.log(density) - begins * CHANGE_COST, abs=1e-3)


@pytest.mark.parametrize("gap", [1.0, 5.0, 40.0, 600.0])
@pytest.mark.parametrize("dwell", [12.0, 200.0, 1000.0])
def test_a_gap_has_the_transitions_of_the_chain(gap, dwell):
    on, off = np.exp(-CHANGE_COST), 1 / dwell
    after = expm(gap * np.array([[-on, on], [off, -off]]))  # from off and on (rows) to off and on
    costs = np.log(after[0, 0] / np.array([after[0, 1], after[1, 0], after[1, 1]]))
    found = gap_costs(gap, dwell)
    assert [found.begins, found.ends, found.stays] == pytest.approx(np.maximum(costs, 0.0).tolist())


def test_a_run_between_gaps_costs_what_the_chain_gives_all_times_that_look_the_same():
    # Between the gaps it is on, before and after them off: it may have begun and ended at any time of the gaps.
    t = np.concatenate([np.arange(100.0), np.arange(130.0, 140.0), np.arange(160.0, 300.0)])
    on, off = np.exp(-CHANGE_COST), 1 / 12.0
    before, after = (expm(gap * np.array([[-on, on], [off, -off]])) for gap in (30.0, 20.0))
    odds = before[0, 1] / before[0, 0] * np.exp(-10 / 12.0) * after[1, 0] / after[0, 0]
    same = [((start, end),) for start in (100.0, 115.0, 129.4) for end in (139.6, 150.0)]
    unseen = sum(12.0 * -np.expm1(-gap / 12.0) for gap in (30.0, 20.0))
    once = rate_cost(1, 240.0 + unseen)
    assert [prior_cost(spans, BRAKE, t) for spans in same] == pytest.approx([once - np.log(odds)] * 6)
    without = rate_cost(1, 240.0) + 2 * CHANGE_COST - np.log(30.0) - np.log(20.0) + DWELL_COST
    assert [cost_without_dwell(spans, t) for spans in same] == pytest.approx([without] * 6)
    ends = [np.log(2 / (1 / 250 + gap / 300)) for gap in (30.0, 20.0)]  # at one of 250 places, or in 30 s of 300
    assert [prior_cost(spans, WET, t) for spans in same] == pytest.approx([sum(ends)] * 6)
    assert len({observed_spans(spans, t) for spans in same}) == 1


def test_what_is_on_at_both_sides_of_a_gap_need_not_have_been_on_in_it():
    t = np.concatenate([np.arange(100.0), np.arange(400.0, 500.0)])
    one, two = ((90.0, 410.0),), ((90.0, 120.0), (390.0, 410.0))
    begins = rate_cost(1 + probability_of_restart(300.0, 12.0), 180.0 + 12.0) + CHANGE_COST
    assert probability_of_restart(300.0, 12.0) == pytest.approx(1.0, abs=1e-6)
    stays = gap_costs(300.0, 12.0).stays
    assert prior_cost(one, BRAKE, t) == pytest.approx(begins + 9.5 / 12 + stays + 10.5 / 12 + np.log(12.0))
    assert prior_cost(two, BRAKE, t) == pytest.approx(prior_cost(one, BRAKE, t))
    apart = [cost_apart(spans, BRAKE.dwell_times, t) for spans in (one, two, ((90.0, 200.0), (200.0, 410.0)))]
    assert apart == pytest.approx([apart[0]] * 3), "in a long gap it began anew in any case"
    assert is_usual(one, BRAKE, t)
    assert not is_usual(one, BRAKE, np.arange(500.0)), "320 s are seen"


def test_a_state_of_its_own_begins_anew_in_a_short_gap_too():
    t = np.concatenate([np.arange(100.0), np.arange(103.0, 200.0)])
    costs = [cost_apart(spans, (12.0,), t) for spans in (((50.0, 150.0),), ((50.0, 101.0), (101.0, 150.0)))]
    gap, off = gap_costs(3.0, 12.0), 197.0 + 12.0 * -np.expm1(-3.0 / 12.0)
    rates = rate_cost(2, off) - rate_cost(1 + probability_of_restart(3.0, 12.0), off)
    assert costs[1] - costs[0] == pytest.approx(gap.ends + gap.begins - gap.stays + rates)
    assert costs[1] - costs[0] > 5.0


def test_costs_of_an_exchange_are_the_least_that_an_effect_may_have():
    assert least_costs(0.0, FAN) == Costs(CHANGE_COST, CHANGE_COST, 0.0)
    each = [gap_costs(60.0, dwell) for dwell in FAN.dwell_times]
    found = least_costs(60.0, FAN)
    assert all(found.begins <= one.begins and found.ends <= one.ends and found.stays <= one.stays for one in each)
    assert least_costs(60.0, WET) == Costs(CHANGE_COST, CHANGE_COST, 0.0)


def test_where_one_span_follows_another_there_is_one_change():
    t = np.arange(200.0)
    one, two = ((50.0, 150.0),), ((50.0, 100.0), (100.0, 150.0))
    more = cost_apart(two, (12.0,), t) - cost_apart(one, (12.0,), t)
    assert more == pytest.approx(np.log(12.0) + rate_cost(2, 200.0) - rate_cost(1, 200.0))


def test_times_that_are_not_seen_are_none():
    t = np.concatenate([np.arange(100.0), np.arange(400.0, 500.0)])
    assert observed_spans(((150.0, 390.0),), t) == ()
    assert not is_usual(((150.0, 160.0),), BRAKE, t)
    assert observed_spans(((90.0, 300.0), (399.5, 410.0)), t) == ((90.0, 99.5), (399.5, 410.0))


def test_leaving_a_gap_costs_what_a_change_costs_more_elsewhere():
    t = np.concatenate([np.arange(100.0), np.arange(400.0, 500.0)])
    gap = gap_costs(300.0, 12.0)
    assert cost_of_leaving(200.0, False, BRAKE, t) == pytest.approx(CHANGE_COST - gap.begins)
    assert cost_of_leaving(200.0, True, BRAKE, t) == pytest.approx(np.log(12.0) - gap.ends)
    wet = np.log((1 / 200 + 300 / 500) / (1 / 200 + 1 / 500))
    assert cost_of_leaving(200.0, True, WET, t) == cost_of_leaving(200.0, False, WET, t) == pytest.approx(wet)
    assert cost_of_leaving(50.2, True, BRAKE, t) == cost_of_leaving(50.2, True, WET, t) == 0.0
