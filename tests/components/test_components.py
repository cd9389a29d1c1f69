"""The likelihood of terms against dense algebra, quadrature and enumeration; the identity of the budget."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from driven_on_hills import SEED, A, C, M, driven
from driven_on_level_road import driven as on_level_road
from hypothesis import given
from hypothesis import strategies as st
from made_strides import made_strides
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.stats import multivariate_normal

from estimator.components import edges, exchange, switching
from estimator.components.budget import NOISE, ROAD, WHITE, Budget, Residuals, budget
from estimator.components.candidate_terms import CandidateTerms, EarlierTerms
from estimator.components.drive_state import DriveState
from estimator.components.hypothesis_space import HypothesisSpace
from estimator.components.likelihood import JointLikelihood
from estimator.components.model_table import ModelTable
from estimator.components.processes import (
    FREQUENCY_STEP,
    MAX_PERIOD,
    MIN_PERIOD,
    SWITCHES,
    hats,
    processes,
    spectrum,
    swings,
    switched,
)
from estimator.components.search import Search
from estimator.components.search_result import ranked, search_result
from estimator.components.set_likelihood import SetLikelihood
from estimator.components.term import Frame, Kind, Term, term_of, untimed_terms
from estimator.components.time_prior import CHANGE_COST, Costs
from estimator.estimation import road_fit
from estimator.estimation.normal_equations import NormalEquations
from estimator.estimation.road_evidence import log_bayes_factor_of_road, log_bayes_factor_of_signals
from estimator.estimation.road_fit import fit, fit_given
from estimator.estimation.road_likelihood import LAG, ROAD_LOAD, Likelihood
from estimator.estimation.savage_dickey import log_bayes_factor, posterior_of
from estimator.model.conditioned import Conditioned
from estimator.model.effect_term import USUAL_SDS, EffectTerm
from estimator.model.effects import BY_NAME, CATALOGUE
from estimator.model.effects.effect import AtRest
from estimator.model.spans import covered, union, without
from estimator.samples import STEP
from estimator.signals import Quantity

ELAPSED = frozenset({Quantity.ELAPSED, Quantity.ENGINE_SPEED})
QUIET = 1e-4  # m/s^2 of torque noise: the correction for it is next to nothing


@pytest.fixture(scope="module")
def strides():
    return driven()


@pytest.fixture(scope="module")
def quiet(strides):
    """A fit whose torque noise is next to nothing, so that no correction stands between us and the formula."""
    found = fit(strides)
    assert found is not None
    values = found.scales.values.copy()
    values[0] = QUIET
    return replace(found, scales=replace(found.scales, values=values))


def joint_likelihood(strides, fit, terms):
    return JointLikelihood(Conditioned.of(fit.scales.model_of(strides), fit.scales.values), fit, terms)


def joint_of(strides, fit, names=("auxiliary_load", "warm_up", "viscous_drag"), further=()):
    frame = Frame.of(fit)
    given = [c for name in names for c in untimed_terms(frame, BY_NAME[name], frozenset(strides.context))[:2]]
    return joint_likelihood(strides, fit, [*given, *further])


def covariance(strides, fit):
    """Of the accelerations (n, n), from the model's products with unit vectors."""
    model = fit.scales.model_of(strides)
    return np.linalg.inv(Conditioned.of(model, fit.scales.values).gram(np.eye(len(strides))))


def test_evidence_is_that_of_the_dense_gaussian(strides, quiet):
    wander = next(p for p in processes(Frame.of(quiet)) if p.name == "force over time")
    free = [
        replace(c, positive=False)
        for c in untimed_terms(Frame.of(quiet), BY_NAME["warm_up"], frozenset(strides.context))
    ]
    joint = joint_likelihood(strides, quiet, [free[0], free[3], wander])
    K, base = covariance(strides, quiet), joint.columns[:, : joint.base_size].toarray()
    K = K + base @ np.diag(1 / joint._prior) @ base.T

    def dense(chosen):
        total = K.copy()
        for i in chosen:
            X = joint.columns[:, joint.term_columns[i]].toarray()
            total += joint.terms[i].sd ** 2 * X @ X.T
        factor = np.linalg.cholesky(total)
        return -np.log(np.diag(factor)).sum() - 0.5 * np.sum(np.linalg.solve(factor, joint.response) ** 2)

    none = joint.log_evidence([])
    for chosen in ([0], [1], [2], [0, 2], [0, 1, 2]):
        assert joint.log_evidence(chosen) - none == pytest.approx(dense(chosen) - dense([]), abs=0.05)


def test_the_bias_by_an_omitted_term_is_the_change_of_the_fit(strides, quiet):
    joint = joint_of(strides, quiet, names=("auxiliary_load", "warm_up"))
    chosen, left_out, size = [1], 0, 5e3
    before = joint.posterior(chosen).mean
    columns = joint.columns.toarray()
    added = size * columns[:, joint.term_columns[left_out][0]]
    products = joint.conditioned.gram(np.column_stack([added, columns]))
    other = SetLikelihood(products, joint._prior, joint.priors, joint.term_columns, joint.unit)
    # Corrected for the noise of the torque, and for answers to slopes.
    other._information, other._moment = joint._information, joint._moment + products[1:, 0]
    change = other.posterior(chosen).mean - before
    assert_allclose(size * joint.omission_bias(chosen, left_out), change, rtol=1e-5, atol=1e-9 * np.abs(before).max())


def test_a_set_with_one_term_more_has_the_evidence_of_that_set(strides, quiet):
    """One of one column or several, positive or not, of possible size or not, with a cost; beside sets of any."""
    joint = joint_of(strides, quiet)
    wandering = next(c for c in processes(joint.frame) if c.name == "force over speed")
    own = [replace(term, cost=0.1 * i) for i, term in enumerate([*joint.terms, wandering])]
    own += [replace(own[0], max_size=1e-3), replace(own[1], positive=not own[1].positive)]
    joint = joint_likelihood(strides, quiet, own)
    for chosen in ([], [0], [1, 3], [len(joint.terms) - 3, 2]):
        others = [i for i in range(len(own)) if i not in chosen]
        one_by_one = [joint.log_evidence([*chosen, i]) for i in others]
        assert_allclose(joint.log_evidence_with(chosen, others), one_by_one, rtol=1e-9, atol=1e-6)
        unlimited = [joint.log_evidence([*chosen, i], check_limits=False) for i in others]
        assert_allclose(joint.log_evidence_with(chosen, others, check_limits=False), unlimited, rtol=1e-9, atol=1e-6)
    assert np.isinf(joint.log_evidence([len(own) - 2]))


@pytest.mark.parametrize("name", ["rotating_inertia", "auxiliary_load"])
def test_a_set_is_corrected_for_answers_as_a_fit_with_the_same_effect(strides, name, monkeypatch):
    """The column of the one effect holds the force itself."""
    found = fit(strides)
    assert found is not None
    terms = untimed_terms(Frame.of(found), BY_NAME[name], frozenset(strides.context))
    free = replace(terms[0], positive=False, sd=USUAL_SDS * terms[0].sd)

    def posterior():
        return joint_likelihood(strides, found, [free]).posterior([0])

    corrected = posterior()
    monkeypatch.setattr("estimator.components.likelihood.DRIVER_FEEDBACK", 0.0)
    shift, sd = corrected.mean - posterior().mean, np.sqrt(np.diag(corrected.covariance))
    assert free.effect_term is not None
    model, scales = found.scales.model_of(strides), found.scales
    likelihood = Likelihood(model, (free.effect_term,), found.road_load, scales.lag, (), found.taken)
    none = np.empty((len(model.driven), 0))
    equations = NormalEquations.of(likelihood, scales.values, scales.free, 0.0, none)
    with_answers, without = equations.solve()[0], replace(equations, driver_bias=0 * equations.driver_bias).solve()[0]
    expected = (with_answers - without) / likelihood.unit
    assert expected[0] > 0.5 * sd[0]
    assert_allclose(shift[:ROAD_LOAD] / sd[:ROAD_LOAD], expected[:ROAD_LOAD] / sd[:ROAD_LOAD], atol=0.1)
    size = -(with_answers[-1] / with_answers[0] - without[-1] / without[0]) * likelihood.unit[0] / likelihood.unit[-1]
    assert shift[-1] / sd[-1] == pytest.approx(size / sd[-1], abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("auxiliary_load", 12e3), ("torque_bias", 90.0)])
def test_a_fit_gives_an_effect_the_evidence_that_a_table_gives_it(name, size):
    """With its prior, its sign, and the power at idle, which tells an effect that the motion hardly shows."""
    truth, turns = BY_NAME[name], 8.0 * driven(900).speed
    rest = AtRest(power=size if name == "auxiliary_load" else 63.0 * size, sd=1.3e3, engine_speed=63.0)
    strides = driven(900, power=size * (np.ones(900) if name == "auxiliary_load" else turns))
    plain = DriveState.of(strides, (rest,))
    term = untimed_terms(Frame.of(plain.fit), truth, frozenset(strides.context))[0]
    having = plain.with_terms((term,))
    scales = having.fit.scales
    bare = fit_given(strides, scales, (), rests=(rest,))
    given = fit_given(strides, scales, having.fit.terms, rests=(rest,))
    with_it, without_it = replace(having, fit=given), replace(plain, fit=bare)
    gain = having.joint.log_evidence([0]) - having.joint.log_evidence([])
    assert with_it.log_evidence - without_it.log_evidence == pytest.approx(gain, abs=0.5)
    posterior = having.joint.posterior([0])
    sd = np.sqrt(posterior.covariance[-1, -1])
    assert having.magnitudes[0] == pytest.approx(posterior.mean[-1], abs=0.3 * sd)
    assert np.sqrt(having.fit.theta_covariance()[-1, -1]) == pytest.approx(sd, rel=0.15)
    assert gain > 5 > replace(having, rests=()).joint.gains([], [0]).gain[0]


def test_power_at_rest_is_a_measurement_of_the_magnitudes():
    """As the product of two Gaussians, to first order: one rest after the other, or all at once."""
    strides = driven(600, power=np.full(600, 9e3))
    frame = Frame.of(DriveState.of(strides).fit)
    terms = [untimed_terms(frame, BY_NAME[name], ELAPSED)[0].effect_term for name in ("auxiliary_load", "torque_bias")]
    found = fit(strides, terms)
    rests = [AtRest(power=9.5e3, sd=700.0, engine_speed=60.0), AtRest(power=8.5e3, sd=900.0, engine_speed=110.0)]
    beta, covariance, evidence = found.beta, found.covariance, 0.0
    for rest in rests:
        beta, covariance, gain = road_fit._beside(rest, beta, covariance, terms)
        evidence += gain
    after = replace(found, beta=beta, covariance=covariance)
    rows = np.array([[0.0, 0.0, 0.0, 0.0, 1.0, rest.engine_speed] for rest in rests]) / [[rest.sd] for rest in rests]
    P, missed = found.theta_covariance(), np.array([rest.power / rest.sd for rest in rests]) - rows @ found.theta
    spread = rows @ P @ rows.T + np.eye(2)
    weights = np.linalg.solve(spread, rows @ P).T
    sds = np.sqrt(np.diag(P))
    assert_allclose((after.theta - found.theta) / sds, weights @ missed / sds, atol=0.03)
    jacobian = road_fit.theta_jacobian(found.beta, len(terms))
    assert_allclose(
        (jacobian @ covariance @ jacobian.T) / np.outer(sds, sds),
        (P - weights @ rows @ P) / np.outer(sds, sds),
        atol=0.05,
    )
    assert evidence == pytest.approx(multivariate_normal.logpdf(missed, cov=spread), abs=0.05)


def test_an_effect_alone_has_the_prior_of_its_sign_whether_its_times_are_given_or_found():
    n, spans = 900, ((200.0, 420.0), (600.0, 760.0))
    state = DriveState.of(driven(n, power=25e3 * covered(np.arange(n) + 0.5, 1.0, spans)))
    fitted = state.fitted_terms([BY_NAME["auxiliary_cycling"]])["auxiliary_cycling"]
    joint = state.joint_with([fitted.term])
    assert fitted.gain == pytest.approx(joint.log_evidence([0]) - joint.log_evidence([]), abs=0.01)


def test_a_positive_magnitude_has_half_a_prior(strides, quiet):
    joint = joint_of(strides, quiet, names=("auxiliary_load",))
    free = replace(joint.terms[0], positive=False)
    both = joint_likelihood(strides, quiet, [free])
    posterior = both.posterior([0])
    mean, sd = posterior.mean[-1], np.sqrt(posterior.covariance[-1, -1])
    above = quad(lambda x: np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi)), 0, mean + 12 * sd)[0]
    assert joint.log_evidence([0]) - both.log_evidence([0]) == pytest.approx(np.log(2 * above), abs=1e-4)


def test_gains_are_differences_of_evidence_and_costs_are_left_to_the_caller(strides, quiet):
    joint = joint_of(strides, quiet)
    for chosen in ([], [0], [0, 3]):
        others = [i for i in range(len(joint.terms)) if i not in chosen]
        gains = joint.gains(chosen, others)
        for gain, i in zip(gains.gain, others, strict=True):
            # The sign of those chosen before is an approximation: each is judged by its own margin.
            free = [i for i in chosen if joint.terms[i].positive]
            if not free:
                assert gain == pytest.approx(joint.log_evidence([*chosen, i]) - joint.log_evidence(chosen), abs=1e-6)
        posterior = joint.posterior([*chosen, others[0]])
        assert gains.value[0] == pytest.approx(posterior.mean[-1])
        assert gains.sd[0] == pytest.approx(np.sqrt(posterior.covariance[-1, -1]))


def test_an_observation_at_rest_is_one_more_gaussian_factor(strides, quiet):
    before, after = (joint_of(strides, quiet, names=("auxiliary_load",)) for _ in range(2))
    after.observe({0: 1 / 800.0}, 5000.0 / 800.0)
    old, new = before.posterior([0]), after.posterior([0])
    mean, variance = old.mean[-1], old.covariance[-1, -1]
    precision = 1 / variance + 1 / 800.0**2
    assert new.mean[-1] == pytest.approx((mean / variance + 5000.0 / 800.0**2) / precision)
    assert new.covariance[-1, -1] == pytest.approx(1 / precision)


def test_an_observation_of_a_sum_counts_those_that_are_in_the_set(strides, quiet):
    """Against the same rows written out: a row of data with both weights."""
    joint = joint_of(strides, quiet, names=("auxiliary_load", "torque_bias"))
    before = joint.posterior([0, 1])
    joint.observe({0: 1 / 800.0, 1: 60.0 / 800.0}, 5000.0 / 800.0)
    after = joint.posterior([0, 1])
    row = np.zeros(len(before.mean))
    row[-2:] = [1 / 800.0, 60.0 / 800.0]
    gain = before.covariance @ row / (1 + row @ before.covariance @ row)
    assert after.mean[-2:] == pytest.approx((before.mean + gain * (5000.0 / 800.0 - row @ before.mean))[-2:], rel=1e-6)
    alone = joint_of(strides, quiet, names=("auxiliary_load", "torque_bias"))
    alone.observe({0: 1 / 800.0}, 5000.0 / 800.0)
    assert joint.log_evidence([0]) == pytest.approx(alone.log_evidence([0]))


def test_projected_products_are_those_of_the_columns_off_the_set(strides, quiet):
    joint = joint_of(strides, quiet)
    products, score = joint.projected([0], joint.terms[2].columns(joint.frame))
    gains = joint.gains([0], [2])
    precision = products[0, 0] + joint.terms[2].sd ** -2.0
    assert score[0] / precision == pytest.approx(gains.value[0])
    assert precision**-0.5 == pytest.approx(gains.sd[0])


def test_the_weighed_residual_gives_the_scores_of_columns(strides, quiet):
    joint = joint_of(strides, quiet)
    columns = joint.terms[2].columns(joint.frame)
    _, score = joint.projected([0], columns)
    assert_allclose(columns.T @ joint.weighed_residual([0]), score, rtol=1e-5)


def blocks_of(rng: np.random.Generator, effects: int, b: int) -> np.ndarray:
    """Products (e, e, b, b) of profiles of effects, cut into blocks."""
    root = rng.normal(size=(effects * b, effects * b))
    return (30 * np.eye(effects * b) + root @ root.T).reshape(effects, b, effects, b).swapaxes(1, 2)


def exact_evidence(G, s, priors, on):
    """By the determinant and the solution of the whole system; the signs of the amplitudes are not checked."""
    on = np.array(on, dtype=float)
    score, precision = (s * on).sum(axis=-1), np.diag([prior.sd**-2.0 for prior in priors])
    information = np.einsum("ci,cdij,dj->cd", on, G, on) + precision
    gain = 0.5 * score @ np.linalg.solve(information, score)
    gain -= 0.5 * (np.linalg.slogdet(information)[1] - np.linalg.slogdet(precision)[1])
    return gain - sum(exchange.Changes(p.costs).cost(z > 0) for p, z in zip(priors, on, strict=True))


def prior_of(rng: np.random.Generator, b: int, sd: float = 2.0, **more: Any) -> exchange.SwitchingPrior:
    costs = [Costs(*each) for each in rng.uniform(0.0, CHANGE_COST, (b - 1, 3))]
    return exchange.SwitchingPrior(**{"sd": sd, "is_positive": False, "is_single": False, "costs": costs} | more)


@pytest.mark.parametrize("seed", range(4))
def test_times_are_the_best_of_all_states_of_a_few_blocks(seed):
    rng, b = np.random.default_rng(seed), 9
    G, prior = blocks_of(rng, 1, b), prior_of(rng, b, is_positive=True)
    truth = np.isin(np.arange(b), (2, 3, 4))
    s = G[:, 0] @ (1.5 * truth) + rng.normal(0, 5, b)

    def evidence(on):
        return exact_evidence(G, s, [prior], [on])

    best = max((z for z in product([False, True], repeat=b) if s[0] @ z >= 0), key=evidence)
    found = exchange.best_states(G, s, [prior], np.zeros((1, b), bool))[0]
    assert evidence(found) == pytest.approx(evidence(best))
    once = [z for z in product([False, True], repeat=b) if np.count_nonzero(np.diff(np.pad(z, 1))) <= 2]
    one = exchange.best_states(G, s, [replace(prior, is_single=True)], np.zeros((1, b), bool))[0]
    assert np.count_nonzero(np.diff(np.pad(one, 1))) <= 2
    assert evidence(one) <= max(map(evidence, once)) + 1e-9


def test_any_number_of_runs_is_found():
    rng, b = np.random.default_rng(3), 240
    truth = np.arange(b) % 3 == 1
    G = np.zeros((1, 1, b, b))
    G[0, 0, range(b), range(b)] = rng.uniform(50.0, 100.0, b)
    s = G[:, 0] @ (1.5 * truth) + rng.normal(0, 5, b)
    prior = prior_of(rng, b, costs=[Costs(CHANGE_COST, CHANGE_COST, 0.0)] * (b - 1))
    found = exchange.best_states(G, s, [prior], np.zeros((1, b), bool))[0]
    assert_array_equal(found, truth)


@pytest.mark.parametrize("seed", range(4))
def test_blocks_pass_from_an_effect_that_holds_them_to_the_one_that_acts(seed):
    rng, b = np.random.default_rng(seed), 6
    truth = np.array([[0, 1, 1, 0, 0, 0], [0, 0, 0, 0, 1, 1]], dtype=bool)
    profiles = np.abs(rng.normal(1.0, 0.4, (2, b, 40)))  # of blocks of 40 strides; the two effects are much alike
    G = np.zeros((2, 2, b, b))
    G[:, :, range(b), range(b)] = np.einsum("cbn,dbn->cdb", profiles, profiles)
    s = np.einsum("cdij,dj->ci", G, 3.0 * truth) + rng.normal(0, 1, (2, b))
    priors = [prior_of(rng, b, costs=[Costs(CHANGE_COST, CHANGE_COST, 0.0)] * (b - 1)) for _ in range(2)]
    start = np.array([truth.any(axis=0), np.zeros(b, dtype=bool)])
    found = exchange.best_states(G, s, priors, start)
    states = (np.reshape(z, (2, b)) for z in product([False, True], repeat=2 * b))
    best = max(states, key=lambda on: exact_evidence(G, s, priors, on))
    assert_array_equal(found, best)
    assert_array_equal(found, truth)


@pytest.mark.parametrize("seed", range(4))
def test_evidence_of_exchanged_runs_is_that_of_the_states_computed_anew(seed):
    rng, b = np.random.default_rng(seed), 7
    G, s, on = blocks_of(rng, 2, b), rng.normal(0, 40, (2, b)), rng.random((2, b)) < 0.5
    priors, moves = [prior_of(rng, b), prior_of(rng, b, sd=0.5)], [[0], [1], [0, 1]]
    first, last = exchange._runs(on)
    moved, present = exchange._Blocks(G, s, priors).evidence_of_moves(on, first, last, moves)
    assert present == pytest.approx(exact_evidence(G, s, priors, on))
    for effects, evidence in zip(moves, moved, strict=True):
        for k, (start, end) in enumerate(zip(first, last, strict=True)):
            after = on.copy()
            after[effects, start:end] ^= True
            assert evidence[k] == pytest.approx(exact_evidence(G, s, priors, after))


def test_an_amplitude_that_would_be_negative_beside_another_is_impossible():
    score, strength = np.array([2.0, 0.5]), np.array([[1.0, 0.9], [0.9, 1.0]])
    assert np.isfinite(exchange.joint_evidence(score, strength, [1.0, 1.0], [True, False]))
    assert exchange.joint_evidence(score, strength, [1.0, 1.0], [True, True]) == -np.inf  # it has a positive score


def test_costs_of_an_exchange_are_those_of_the_states_counted_anew():
    rng = np.random.default_rng(1)
    first, last = np.triu_indices(12)
    changes = exchange.Changes([Costs(*each) for each in rng.uniform(0.0, CHANGE_COST, (11, 3))])
    for _ in range(20):
        on = rng.random(12) < 0.5
        more, edges = changes.by_run(on, first, last + 1), exchange.edges_by_run(on, first, last + 1)
        for k, (a, e) in enumerate(zip(first, last + 1, strict=True)):
            if on[a:e].all() or not on[a:e].any():
                without, with_run = on.copy(), on.copy()
                without[a:e], with_run[a:e] = False, True
                sign = -1 if on[a] else 1
                assert more[k] == pytest.approx(changes.cost(with_run) - changes.cost(without))
                after = np.pad(with_run if sign > 0 else without, 1)
                assert sign * edges[k] == np.count_nonzero(np.diff(after)) - np.count_nonzero(np.diff(np.pad(on, 1)))


@pytest.mark.slow
def test_no_move_of_an_edge_adds_evidence_to_refined_ones():
    effect, t = BY_NAME["auxiliary_cycling"], np.arange(400) + 0.5
    truth = ((100.4, 140.9), (250.2, 301.7))
    joint = DriveState.of(driven(power=40e3 * covered(t, 1.0, truth))).joint
    sd = effect.usual_magnitude(joint.frame.road_load)

    def evidence(spans):
        G, s = joint.projected([], joint.frame.column(EffectTerm(effect, None, spans))[:, None])
        return float(log_bayes_factor(*posterior_of(s[0], G[0, 0], sd), sd))

    start = ((101.5, 139.0), (249.0, 303.5))
    found = edges.with_refined_edges(joint, [], EffectTerm(effect, None, start))
    assert_allclose(found, truth, atol=0.31)
    assert evidence(found) > evidence(start)
    for i, j in product((0, 1), (0, 1)):
        for move in (*edges.MOVES, 0.0):
            moved = np.array(found)
            moved[i, j] = start[i][j] + move
            assert evidence(tuple(map(tuple, moved.tolist()))) <= evidence(found) + 1e-3


def test_products_of_steps_are_sums_over_the_parts_between_them(strides, quiet):
    joint = joint_of(strides, quiet)
    column = joint.terms[0].columns(joint.frame)[:, 0]
    n, probed = len(column), np.arange(1, len(column), 50)
    steps = np.where(np.arange(n)[:, None] >= probed, column[:, None], 0.0)
    products, _ = joint.projected([1], steps)
    parts, _ = joint.projected([1], switching._parts(column, np.searchsorted(probed, np.arange(n), side="right")))
    sums = parts[::-1, ::-1].cumsum(axis=0).cumsum(axis=1)[::-1, ::-1]
    assert_allclose(sums[1:, 1:], products, rtol=1e-6, atol=1e-6 * np.diag(products).max())


def test_steps_are_the_highest_peaks_that_are_apart():
    values = np.random.default_rng(2).normal(size=900)
    peaks, _ = find_peaks(values, distance=switching.MIN_STEP_DISTANCE)
    highest = peaks[np.argsort(-values[peaks])][: switching.MAX_STEPS]
    assert len(peaks) < switching.MAX_STEPS
    assert switching.highest_peaks(values).tolist() == highest.tolist()


def test_hats_are_a_partition_of_one():
    axis = np.random.default_rng(0).uniform(3.0, 50.0, 300)
    assert_allclose(hats(axis, 7.0).sum(axis=1), 1.0)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_load_is_found_beside_hidden_hills_and_nothing_where_nothing_is():
    n = 2400
    effects = [effect for effect in CATALOGUE if not effect.is_absorbed and not effect.is_gravity]
    for power, named in ((np.zeros(n), []), (np.full(n, 15e3), ["auxiliary_load"])):
        state = DriveState.of(driven(n, power=power), (AtRest(power=float(power[0]), sd=800.0, engine_speed=60.0),))
        found = Search((state,), effects).result()
        assert [choice.name for choice in found.chosen] == named
        assert [term.name for term in found.drives[0].chosen] == named
    (state,) = found.drives
    assert state.joint.posterior([0]).mean[-1] == pytest.approx(15e3, rel=0.1)


@pytest.mark.slow
@given(st.lists(st.booleans(), min_size=1, max_size=20), st.lists(st.booleans(), min_size=1, max_size=20))
def test_times_of_one_or_both_and_of_one_alone_are_those_of_every_moment(one, other):
    def spans(on):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
        return tuple((float(a), float(b)) for a, b in edges.reshape(-1, 2))

    def within(times, k):
        return any(start < k + 0.5 < end for start, end in times)

    size = max(len(one), len(other))
    a, b = spans(one), spans(other)
    for k in range(size):
        assert within(union(a, b), k) == (within(a, k) or within(b, k))
        assert within(without(a, b), k) == (within(a, k) and not within(b, k))


@pytest.mark.slow
def test_a_search_is_given_up_where_it_will_not_reach_the_evidence_that_is_asked_for():
    state = DriveState.of(driven(600, power=np.full(600, 15e3)))
    found = Search((state,), [BY_NAME["auxiliary_load"]]).result().log_posterior
    for least, is_reached in ((found - 1, True), (found + 1000, False)):
        again = Search((state,), [BY_NAME["auxiliary_load"]]).result_above(least)
        assert (again is not None) == is_reached


@pytest.mark.nightly
def test_times_of_a_load_that_switches_are_found_beside_hidden_hills():
    n = 2400
    on = (np.arange(n) % 800) > 500
    state = DriveState.of(driven(n, power=60e3 * on))
    effects = [BY_NAME["auxiliary_cycling"]]
    found = Search((state,), effects).result()
    (state,) = found.drives
    (term,) = state.chosen
    starts = np.array([span[0] for span in term.spans])
    assert_allclose(starts, [501, 1301, 2101], atol=2.0)
    assert state.joint.posterior([0]).mean[-1] == pytest.approx(60e3, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("fan_acts", "is_shown"), [(False, False), (True, False), (True, True)])
def test_times_pass_from_an_effect_that_holds_them_to_the_one_that_acts(fan_acts, is_shown):
    """The fan holds times of the brake: fitted ones, or those of a signal."""
    n, brake, fan = 1500, BY_NAME["brake_use"], BY_NAME["auxiliary_cycling"]
    of_brake, of_fan = ((200.0, 225.0), (520.0, 538.0), (860.0, 885.0)), ((1100.0, 1290.0),) if fan_acts else ()
    held = (*of_brake[1:], *of_fan)
    strides = driven(n)
    power = 5e3 * covered(strides.t, 1.0, of_brake) * 0.5 * (strides.v0 + strides.v1)
    strides = driven(n, power=power + 60e3 * covered(strides.t, 1.0, of_fan))
    turning = {Quantity.FAN_SPEED: 100.0 * covered(strides.t, 1.0, held)}
    state = DriveState.of(replace(strides, context={**strides.context, **turning}))
    by_fan = EffectTerm(fan, Quantity.FAN_SPEED) if is_shown else EffectTerm(fan, None, held)
    terms = EffectTerm(brake, None, of_brake[:1]), by_fan
    state = state.with_terms(tuple(term_of(Frame.of(state.fit), term) for term in terms))
    times = switching.Switching(state.joint).best_pair((brake, fan))
    assert_allclose(times[brake.name], of_brake, atol=1.0)
    assert_allclose(np.reshape(times[fan.name], (-1, 2)), np.reshape(of_fan, (-1, 2)), atol=1.0)


def test_times_of_an_effect_do_not_depend_on_what_was_asked_before():
    """A wet road has the profile of a brake, and is looked for beside it."""
    n, spans, brake = 900, ((200.0, 225.0), (520.0, 538.0)), BY_NAME["brake_use"]
    strides = driven(n)
    strides = driven(n, power=5e3 * covered(strides.t, 1.0, spans) * 0.5 * (strides.v0 + strides.v1))
    state = DriveState.of(strides)
    state = state.with_terms((term_of(Frame.of(state.fit), EffectTerm(brake, None, spans[:1])),))
    alone, asked = switching.Switching(state.joint), switching.Switching(state.joint)
    asked.best([0], BY_NAME["resistance_segment"])
    times, _ = alone.best([], brake, [0])
    assert_allclose(times, spans, atol=2.0)
    assert asked.best([], brake, [0])[0] == times


@pytest.mark.slow
def test_ends_of_a_span_are_found_to_a_tenth_of_a_second():
    n = 1200
    t = np.arange(n) + 0.5
    spans = ((300.3, 420.8), (700.6, 790.2))
    strides = driven(n, power=60e3 * covered(t, 1.0, spans))
    state = DriveState.of(strides)
    rough = tuple((round(a) + 2.0, round(b) - 2.0) for a, b in spans)
    found = switching.with_refined_edges(state.joint, [], EffectTerm(BY_NAME["auxiliary_cycling"], None, rough))
    assert_allclose(found, spans, atol=0.35)  # the noise of a stride is 15 % of what the load takes


def test_the_share_of_a_stride_that_is_covered_is_its_overlap():
    t = np.arange(10) + 0.5
    assert_allclose(covered(t, 1.0, ((2.25, 4.5), (8.0, 8.1))), [0, 0, 0.75, 1, 0.5, 0, 0, 0, 0.1, 0])
    assert_allclose(covered(t, 0.0, ((2.25, 4.5),)), [0, 0, 1, 1, 1, 0, 0, 0, 0, 0])
    assert_allclose(covered(t, 1.0, ()), np.zeros(10))


@given(
    edges=st.lists(st.floats(-50.0, 150.0), max_size=12, unique=True),
    durations=st.lists(st.floats(0.1, 40.0), min_size=1, max_size=9),
)
def test_the_share_that_is_covered_is_the_sum_of_the_overlaps_with_each_span(edges, durations):
    ordered = sorted(edges)
    spans = tuple(zip(ordered[::2], ordered[1::2], strict=False))
    duration = np.array(durations)
    t = np.linspace(0.0, 100.0, len(duration))
    overlaps = [
        sum(max(min(end, x + d / 2) - max(start, x - d / 2), 0.0) for start, end in spans) / d
        for x, d in zip(t.tolist(), durations, strict=True)
    ]
    share = covered(t, duration, spans)
    assert_allclose(share, overlaps, atol=1e-9)
    apart = [
        all(end <= x - d / 2 or x + d / 2 <= start for start, end in spans) for x, d in zip(t, duration, strict=True)
    ]
    assert not share[apart].any()  # to the bit: columns are zero where nothing acts


@pytest.mark.slow
def test_the_period_of_a_load_that_swings_is_among_those_tried():
    n = 1800
    t = np.arange(n) + 0.5
    state = on_level_road(20e3 * np.sin(2 * np.pi * t / 47.0), n / 60)
    joint = state.joint
    tried = list(swings(joint, [[]]))
    both = state.joint_with(tried)
    gains = [both.log_evidence([i]) - both.log_evidence([]) for i in range(len(tried))]
    wave = tried[int(np.argmax(gains))].columns(joint.frame)[:, 0] * state.fit.strides.speed
    power = np.abs(np.fft.rfft(wave - wave.mean()))
    assert max(gains) > 10
    assert n / int(np.argmax(power)) == pytest.approx(47.0, abs=1.5)


@pytest.mark.slow
def test_the_spectrum_is_the_sum_over_all_times_at_each_frequency():
    rng = np.random.default_rng(SEED)
    t = np.unique(rng.integers(0, 9000, 400)) * STEP
    t, values = t - t[0], rng.normal(size=len(t))
    frequencies, sizes = spectrum(t, values)
    step = frequencies[1] - frequencies[0]
    assert 0.7 * FREQUENCY_STEP < step * t[-1] <= FREQUENCY_STEP
    assert_allclose(frequencies, np.arange(1 / MAX_PERIOD, 1 / MIN_PERIOD, step))
    assert_allclose(sizes, np.abs(np.exp(2j * np.pi * np.outer(frequencies, t)) @ values))


@pytest.mark.nightly
def test_a_power_that_switches_and_is_larger_than_any_effect_has_no_name_of_the_catalogue():
    n, size = 2400, 150e3
    spans = ((500.3, 800.0), (1300.0, 1500.7))
    power = size * covered(np.arange(n) + 0.5, 1.0, spans)
    names = ("auxiliary_cycling", "drafting", "brake_use", "resistance_segment")
    found = Search((DriveState.of(driven(n, power=power)),), [BY_NAME[name] for name in names]).result()
    assert found.chosen == ()
    process = found.nameless.term_by_drive[0]
    assert SWITCHES[process.name] == "W"
    assert_allclose(process.spans, spans, atol=0.5)
    (state,) = found.drives
    assert state.joint_with((process,)).posterior([0]).mean[-1] == pytest.approx(size, rel=0.1)


@pytest.mark.slow
def test_an_effect_that_is_given_may_be_larger_than_one_that_is_found():
    """It is the user's choice; others are found beside it."""
    n, spans = 1200, ((250.0, 400.0), (650.0, 800.0))
    power = 15e3 + 150e3 * covered(np.arange(n) + 0.5, 1.0, spans)
    plain = DriveState.of(driven(n, power=power), (AtRest(power=15e3, sd=800.0, engine_speed=60.0),))
    fan = term_of(Frame.of(plain.fit), EffectTerm(BY_NAME["auxiliary_cycling"], None, spans))
    state = plain.with_terms((fan,))
    assert state.joint.posterior([0]).mean[-1] > 2 * fan.max_size
    assert [choice.name for choice in Search((state,), [BY_NAME["auxiliary_load"]]).result().chosen] == [
        "auxiliary_load"
    ]


def test_the_noise_of_the_force_is_in_a_gain_that_wanders_as_it_is_in_the_mass(strides):
    """Mass and mean gain have one column: counted in one alone, its noise would drive them apart."""
    plain = DriveState.of(strides)
    frame = Frame.of(plain.fit)
    wide = max((p for p in processes(frame) if p.name == "gain over time"), key=lambda p: p.sd)
    beside = plain.with_terms((), (wide,)).fit
    gains = beside.theta[LAG + 1 :]
    assert abs(gains.mean()) < 0.5 * wide.sd
    assert beside.theta[2] == pytest.approx(plain.fit.theta[2], rel=0.05)


def test_a_gain_that_rises_with_the_torque_is_finite_where_the_engine_rests(strides):
    strides = replace(strides, context=dict(strides.context))
    strides.context[Quantity.ENGINE_SPEED] = np.where(np.arange(len(strides)) < 50, 0.0, 8.0 * strides.speed)
    frame = Frame.of(DriveState.of(strides).fit)
    bent = next(p for p in processes(frame) if p.name == "gain over torque").columns(frame)
    assert np.isfinite(bent).all()
    share = np.abs(frame.force) / 8.0
    share /= np.quantile(share[50:], 0.99)
    running = bent[50:, 1] / bent[50:, 0]  # one column is the other one times the torque
    assert_allclose(running / running.max(), share[50:] / share[50:].max(), rtol=1e-9)


@pytest.mark.slow
def test_gusts_of_half_a_minute_are_a_drag_over_time():
    v = on_level_road().fit.strides.speed
    gusts = gaussian_filter1d(np.random.default_rng(SEED).standard_normal(len(v)), 25.0)
    found = Search((on_level_road(2 * C * v**2 * 0.6 * gusts / gusts.std()),), [BY_NAME["drafting"]]).result()
    assert not found.chosen
    assert [process.name for process in found.nameless.term_by_drive.values()] == ["drag over time"]
    assert found.nameless.log_bayes_factor > 1000  # 281 with hats of two minutes


def test_what_acts_in_one_gear_is_told_by_engine_and_road_speed(strides):
    is_high = np.arange(len(strides)) % 90 < 50
    turns = np.where(is_high, 6.5, 8.0) * strides.speed
    frame = Frame.of(DriveState.of(replace(strides, context=strides.context | {Quantity.ENGINE_SPEED: turns})).fit)
    columns = next(p for p in processes(frame) if p.name == "force over gear ratio").columns(frame)
    in_gear = columns[:, np.abs(columns[is_high]).max(axis=0) < 1e-9].sum(axis=1)
    assert_allclose(in_gear, np.where(is_high, 0.0, frame.as_acceleration(strides.speed)), atol=1e-9)


@pytest.mark.slow
def test_an_engine_that_rests_is_in_no_gear(strides):
    rests = np.arange(len(strides)) < 50
    context = strides.context | {Quantity.ENGINE_SPEED: np.where(rests, 0.0, 8.0 * strides.speed)}
    frame = Frame.of(DriveState.of(replace(strides, context=context)).fit)
    columns = next(p for p in processes(frame) if p.name == "force over gear ratio").columns(frame)
    assert_allclose(columns.sum(axis=1), np.where(rests, 0.0, frame.as_acceleration(strides.speed)))
    context[Quantity.ENGINE_SPEED] = np.zeros(len(strides))
    resting = Frame.of(DriveState.of(replace(strides, context=context)).fit)
    assert "force over gear ratio" not in {process.name for process in processes(resting)}


def test_what_is_smaller_than_the_error_of_a_large_effects_form_is_taken_out():
    """A thousandth of the largest gain, or a hundredth where the times are fitted; processes stay."""
    gains = {0: 4000.0, 1: 4.1, 2: 3.9, 3: 41.0, 4: 39.0, 5: 1.0}
    space = SimpleNamespace(
        gain=lambda chosen, removed: gains[removed[0]],
        kind=lambda i: Kind.PROCESS if i == 5 else Kind.EFFECT,
        term=lambda i: SimpleNamespace(is_timed=i in (3, 4)),
    )
    assert HypothesisSpace.without_small_gains(space, tuple(gains)) == (0, 1, 3, 5)


@pytest.mark.slow
def test_parts_of_the_budget_sum_to_the_whole_and_are_those_of_the_truth():
    n = 1600
    on = (np.arange(n) % 800) > 500
    power = 60e3 * on
    strides = driven(n, power=power)
    found = Search((DriveState.of(strides),), [BY_NAME["auxiliary_cycling"]]).result()
    whole = budget(found.drives, [[]], [[]], np.random.default_rng(1))
    assert sum(part.share for part in whole.parts) == pytest.approx(1.0, abs=1e-9)
    # The true parts, off the plain columns as the residual is.
    v, F = strides.speed, strides.force[:, 0]
    X = np.column_stack([strides.a, np.ones(n), v**2, np.minimum(F, 0.0)]) * v[:, None]

    def off(x):
        rest = x - X @ np.linalg.lstsq(X, x, rcond=None)[0]
        return 0.5 * (rest[0::2] + rest[1::2])

    residual, load = off(F * v), off(power)
    assert whole.base == pytest.approx(np.sqrt(np.mean(residual**2)), rel=0.02)
    part = whole.part("auxiliary_cycling")
    assert part.share == pytest.approx(residual @ load / (residual @ residual), abs=0.05)
    assert whole.part(ROAD).share + part.share > 0.9
    assert part.held_out_rms < 0.97 * whole.base
    assert part.expected < whole.base
    assert whole.part(NOISE).held_out_rms is None
    # Given, it leaves the errors of its own alone.
    known = budget(found.drives, [[]], [[]], np.random.default_rng(1), {"auxiliary_cycling"})
    assert sum(part.share for part in known.parts) == pytest.approx(1.0, abs=1e-9)
    assert known.base == pytest.approx(part.held_out_rms)
    assert known.part("auxiliary_cycling").rms < 0.3 * part.rms
    assert known.part("auxiliary_cycling").held_out_rms is None
    counted = [x for x in known.parts if x.cause not in (NOISE, WHITE)]  # the error of a given cause is of the gap too
    assert sum(x.closed[0] for x in counted) == pytest.approx(1.0, abs=0.1)


def test_the_residual_with_some_causes_is_that_of_all_drives_without_their_powers():
    rng = np.random.default_rng(3)
    drives = [
        Residuals(plain=r, given=r, held_out=r, road_known=r, causes=causes)
        for r, causes in (
            (rng.normal(size=50), {"a": rng.normal(size=50), "b": rng.normal(size=50)}),
            (rng.normal(size=30), {"b": rng.normal(size=30)}),
        )
    ]
    whole = Budget(base=1.0, held_out_rms=1.0, parts=(), residuals=tuple(drives))
    left = np.concatenate([drives[0].given - drives[0].causes["a"] - drives[0].causes["b"]])
    left = np.concatenate([left, drives[1].given - drives[1].causes["b"]])
    assert whole.residual_with(["a", "b"]) == pytest.approx(np.sqrt(np.mean(left**2)))
    assert whole.residual_with([]) == pytest.approx(np.sqrt(np.mean(np.concatenate([d.given for d in drives]) ** 2)))


@pytest.mark.slow
def test_a_cause_of_one_drive_only_counts_among_several():
    n = 1200
    load = Term(
        name="auxiliary_load",
        columns=lambda frame: frame.as_acceleration(np.ones((len(frame.strides), 1))),
        sd=8e3,
        effect_term=EffectTerm(BY_NAME["auxiliary_load"]),
    )
    loaded, plain = (DriveState.of(driven(n, seed, np.full(n, 15e3))) for seed in (1, 2))
    for drives in ((loaded.with_terms((load,)), plain), (plain, loaded.with_terms((load,)))):
        whole = budget(drives, [[], []], [[], []], np.random.default_rng(1))
        assert sum(part.share for part in whole.parts) == pytest.approx(1.0, abs=1e-9)
        assert whole.part("auxiliary_load").held_out_rms is not None


@pytest.mark.slow
def test_effects_are_compared_with_processes_by_the_most_probable_set_of_either_alone():
    """A process that takes the place of one effect in the best set says nothing of what the effects explain."""
    drag, fan = (BY_NAME[name] for name in ("viscous_drag", "auxiliary_load"))
    state = on_level_road(3e3 + 10 * on_level_road().fit.strides.speed ** 2)
    candidates = CandidateTerms([drag, fan], [()], EarlierTerms())
    terms = candidates.on_drive(0, state, with_processes=True, with_stretches=False)
    space = HypothesisSpace((state,), [()], [terms])
    names = [space.term(i).name for i in range(len(space.keys))]
    numbers = names.index(drag.name), names.index(fan.name)

    def log_evidence(*hypothesis: int) -> float:
        return space.log_evidence(hypothesis, check_limits=False)

    process = max((i for i in range(len(names)) if space.kind(i) is Kind.PROCESS), key=log_evidence)
    hypotheses = (numbers[0], process), (process,), numbers, numbers[:1], ()
    table = ModelTable(hypotheses, np.array([0.7, 0.1, 0.1, 0.06, 0.04]), 0.0)
    ranking = ranked((state,), [drag, fan])
    found = search_result(space, table, table.best, space.fitted(table.best), ranking, [drag, fan])
    none = log_evidence()
    assert found.log_bf_effects == pytest.approx(log_evidence(*numbers) - none)
    assert found.log_bf_effects > log_evidence(numbers[0]) - none + 5
    assert found.log_bf_processes == pytest.approx(log_evidence(process) - none)
    assert found.log_bf_chosen_processes == found.log_bf_processes > 0


@pytest.mark.slow
def test_the_road_load_is_averaged_over_hypotheses(strides, quiet):
    state = DriveState(strides=strides, fit=quiet)
    effects = [BY_NAME[name] for name in ("auxiliary_load", "viscous_drag", "warm_up")]
    candidates = CandidateTerms(effects, [()], EarlierTerms())
    terms = candidates.on_drive(0, state, with_processes=False, with_stretches=False)
    space = HypothesisSpace((state,), [()], [terms])
    names = [space.term(i).name for i in range(len(space.keys))]
    load, drag, tyres = (names.index(effect.name) for effect in effects)
    others = [i for i, name in enumerate(names) if name == "warm_up" and i != tyres]
    weights = {(): 0.5, (load,): 0.3, (drag, load): 0.2}
    table = ModelTable(tuple(weights), np.array(list(weights.values())), 0.0)

    (found,) = space.other_hypotheses(table, ())

    terms = [space.term(i) for i in range(len(space.keys))]
    likelihood, rng, draws = (
        joint_likelihood(strides, quiet, terms),
        np.random.default_rng(5),
        [],
    )
    for own, weight in weights.items():
        posterior = likelihood.posterior(own)
        each = rng.multivariate_normal(posterior.mean, posterior.covariance, int(2e6 * weight), method="cholesky")
        for place, i in enumerate(own, start=likelihood.base_size):
            each = each[each[:, place] > 0] if terms[i].positive else each
        take = rng.integers(0, len(each), int(2e5 * weight))
        draws.append(each[take, : likelihood.base_size])
    alone = likelihood.posterior(())
    unit = np.sqrt(np.diag(alone.covariance))[:ROAD_LOAD]
    every = np.concatenate(draws)[:, :ROAD_LOAD]
    shift = (every.mean(axis=0) - alone.mean[:ROAD_LOAD]) / unit
    wider = (np.cov(every.T) - alone.covariance[:ROAD_LOAD, :ROAD_LOAD]) / np.outer(unit, unit)
    assert_allclose(found.shift[:ROAD_LOAD] / unit, shift, atol=0.02)
    assert_allclose(found.covariance[:ROAD_LOAD, :ROAD_LOAD] / np.outer(unit, unit), wider, atol=0.1)
    assert abs(shift).max() > 0.1
    (same,) = space.other_hypotheses(replace(table, hypotheses=((tyres,), *((i,) for i in others[:2]))), (tyres,))
    assert not same.shift.any()
    assert not same.covariance.any()


@pytest.mark.slow
def test_draws_of_the_unknowns_have_the_posterior_mean(strides, quiet):
    model = quiet.scales.model_of(strides)
    conditioned = Conditioned.of(model, quiet.scales.values)
    residual = np.random.default_rng(4).normal(0, 0.05, len(strides))
    draws = conditioned.draws(np.repeat(residual[:, None], 4000, axis=1), np.random.default_rng(5))
    slope = model.slope_under(strides, draws)
    mean = model.slope_under(strides, conditioned.unknowns(residual))
    assert_allclose(slope.mean(axis=1), mean, atol=5 * slope.std(axis=1).max() / np.sqrt(4000))


def test_a_term_states_whether_noise_of_the_force_is_in_it(strides, quiet):
    frame = Frame.of(quiet)
    disturbed = frame.disturbed(500.0)
    terms: list[Term] = list(processes(frame))
    for effect in CATALOGUE:
        if not effect.is_absorbed and not effect.is_gravity:
            terms += untimed_terms(frame, effect, frozenset(strides.context))[:1]
    for term in terms:
        changed = not np.allclose(term.columns(frame), term.columns(disturbed))
        assert changed == term.is_noisy, term.name


def test_a_load_step_holds_from_the_first_stride_after_the_stop_to_the_last(strides):
    after = np.arange(len(strides)) > 150
    stopped = replace(strides, context=strides.context | {Quantity.STOPS: after.astype(float)})
    frame = Frame.of(fit(stopped))
    (step,) = untimed_terms(frame, BY_NAME["mass_step"], frozenset(stopped.context))
    assert_allclose(covered(strides.t, 1.0, step.spans), after)


def test_a_force_that_is_nearly_always_on_is_no_process_of_its_own(quiet):
    frame = Frame.of(quiet)
    assert not list(switched(frame, ((0.0, 200.0), (201.0, 400.0))))
    assert [process.name for process in switched(frame, ((100.0, 200.0),))] == list(SWITCHES)


@pytest.mark.slow
def test_what_was_climbed_counts_the_road_between_strides_too(strides):
    whole = fit(replace(strides, altitude=altitude_of(strides)))
    known = np.ones(len(strides), bool)
    known[100:160] = False
    gappy = fit(replace(strides, altitude=altitude_of(strides), known=known))
    rise = np.diff(altitude_of(strides))
    assert whole.climbed == pytest.approx(rise[rise > 0].sum(), rel=0.05)
    assert gappy.climbed == pytest.approx(whole.climbed, rel=0.05)


@pytest.mark.slow
def test_signals_of_the_road_are_told_from_those_of_another_one(strides):
    noise = np.random.default_rng(2).normal(0.0, 0.5, len(strides))
    own = replace(strides, altitude=altitude_of(strides) + noise)
    other = replace(strides, altitude=altitude_of(strides)[::-1] + noise)
    for shown, is_own in ((own, True), (other, False)):
        found = fit(shown)
        assert (log_bayes_factor_of_signals(shown, found) > 0) == is_own
        assert log_bayes_factor_of_road(shown, found) > 100


def altitude_of(strides):
    s = 0.5 * (strides.s0 + strides.s1)
    fine = np.arange(0.0, s[-1] + 5, 5.0)
    slope = 0.008 * np.sin(2 * np.pi * fine / 700 + 1.0) + 0.004 * np.sin(2 * np.pi * fine / 260)
    return np.interp(s, fine, np.cumsum(slope) * 5.0)


def test_a_load_step_accelerates_with_what_other_effects_leave_of_the_force():
    """With a fan of 40 kW and half the mass more, columns without each other would be wrong by a half."""
    n, rng, step, fan = 900, np.random.default_rng(8), 0.5, 40e3
    speed = 12 + 4 * np.sin(2 * np.pi * np.arange(n + 1) / 70)
    v, a = 0.5 * (speed[1:] + speed[:-1]), np.diff(speed)
    after, on = np.arange(n) >= n // 2, np.arange(n) // 90 % 2 == 1
    force = (1 + step * after) * (M * a + A) + C * v**2 + fan * on / v + M * rng.normal(0, 2e-3, n)
    context = {Quantity.ELAPSED: np.arange(n) + 0.5, Quantity.STOPS: after.astype(float)}
    state = DriveState.of(made_strides(speed, force, context), is_level=True)
    spans = tuple((float(k), float(k + 90)) for k in range(90, n, 180))
    for _ in range(3):
        frame = Frame.of(state.fit)
        (loaded,) = untimed_terms(frame, BY_NAME["mass_step"], frozenset(context))
        state = state.with_terms((term_of(frame, EffectTerm(BY_NAME["auxiliary_cycling"], None, spans)), loaded))
    found_fan, found_share = state.fit.theta[LAG + 1 :]
    assert found_fan == pytest.approx(fan, rel=0.02)
    assert BY_NAME["mass_step"].magnitude_from_coefficient(found_share) == pytest.approx(step, rel=0.02)
    assert state.fit.theta[2] == pytest.approx(M, rel=0.01)
    assert_allclose(state.fit.taken, state.fit.theta[LAG + 1] * on / v, rtol=1e-6, atol=1.0)
