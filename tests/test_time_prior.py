"""Costs of times are those of a Markov chain of two states that is seen while strides are known."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from estimator.components.time_prior import (
    CHANGE_COST,
    Costs,
    cost_without_dwell,
    gaps_at,
    in_gap,
    is_usual,
    least_costs,
    prior_cost,
    rate_cost,
)
from estimator.model.effects import BY_NAME

FAN, WET, BRAKE = (BY_NAME[name] for name in ("auxiliary_cycling", "resistance_segment", "brake_use"))


def test_times_cost_what_a_chain_of_two_states_makes_them_cost():
    # Beginnings come about once in exp(5.5) s, and the probability that a state ends within a second is 1/dwell, so the
    # odds of being on are dwell / exp(5.5) at any time; what the drive cuts off has no end in it.
    t = np.arange(1000.0)
    inside, first, last, whole = (100.0, 120.0), (-0.5, 20.0), (980.0, 999.5), (-0.5, 999.5)
    begins, ends = CHANGE_COST, np.log(25.0)
    never, once, twice = (rate_cost(begins, 999.0) for begins in range(3))
    assert prior_cost((inside,), FAN, t) == pytest.approx(once + begins + ends + 20 / 25)
    assert prior_cost((first,), FAN, t) == pytest.approx(never + begins - np.log(200.0) + 20.5 / 200 + np.log(200.0))
    assert prior_cost((last,), FAN, t) == pytest.approx(once + begins + 19.5 / 200)
    assert prior_cost((whole,), FAN, t) == pytest.approx(never + begins - np.log(200.0) + 1000 / 200)
    assert prior_cost((last, inside), FAN, t) == pytest.approx(twice + 2 * begins + ends + 19.5 / 200 + 20 / 25)
    costs = [prior_cost((span,), WET, t) for span in (inside, first, last, whole)]
    assert costs == pytest.approx([2 * np.log(999.0), np.log(999.0), np.log(999.0), 0.0])


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
    found = in_gap(gap, dwell)
    assert [found.begins, found.ends, found.stays] == pytest.approx(np.maximum(costs, 0.0).tolist())


def test_a_run_between_gaps_costs_what_the_chain_gives_all_times_that_look_the_same():
    # Between the gaps it is on, before and after them off: it may have begun and ended at any time of the gaps.
    t = np.concatenate([np.arange(100.0), np.arange(130.0, 140.0), np.arange(160.0, 300.0)])
    on, off = np.exp(-CHANGE_COST), 1 / 12.0
    before, after = (expm(gap * np.array([[-on, on], [off, -off]])) for gap in (30.0, 20.0))
    odds = before[0, 1] / before[0, 0] * np.exp(-10 / 12.0) * after[1, 0] / after[0, 0]
    same = [((start, end),) for start in (100.0, 115.0, 129.4) for end in (139.6, 150.0)]
    once = rate_cost(1, 299.0)
    assert [prior_cost(spans, BRAKE, t) for spans in same] == pytest.approx([once - np.log(odds)] * 6)
    assert cost_without_dwell(same[0], t) == pytest.approx(once + 2 * CHANGE_COST - np.log(30.0) - np.log(20.0))
    assert prior_cost(same[0], WET, t) == pytest.approx(2 * np.log(299.0))


def test_what_is_on_at_both_sides_of_a_gap_need_not_have_been_on_in_it():
    t = np.concatenate([np.arange(100.0), np.arange(400.0, 500.0)])
    one, two = ((90.0, 410.0),), ((90.0, 120.0), (390.0, 410.0))
    begins = rate_cost(1, 499.0) + CHANGE_COST
    stays = in_gap(300.0, 12.0).stays
    assert prior_cost(one, BRAKE, t) == pytest.approx(begins + 9.5 / 12 + stays + 10.5 / 12 + np.log(12.0))
    assert prior_cost(two, BRAKE, t) == pytest.approx(prior_cost(one, BRAKE, t))
    assert is_usual(one, BRAKE, t)
    assert not is_usual(one, BRAKE, np.arange(500.0)), "320 s are seen"


def test_costs_of_an_exchange_are_the_least_that_an_effect_may_have():
    assert least_costs(0.0, FAN) == Costs(CHANGE_COST, CHANGE_COST, 0.0)
    each = [in_gap(60.0, dwell) for dwell in FAN.dwells]
    found = least_costs(60.0, FAN)
    assert all(found.begins <= one.begins and found.ends <= one.ends and found.stays <= one.stays for one in each)
    assert least_costs(60.0, WET) == Costs(CHANGE_COST, CHANGE_COST, 0.0)


def test_gaps_are_those_that_edges_lie_in():
    t = np.array([0.0, 1.0, 2.0, 12.0, 13.0])
    assert gaps_at([-1.0, 0.5, 2.4, 7.0, 11.9, 12.5, 20.0], t) == pytest.approx([0.0, 9.0, 9.0, 9.0, 0.0])
