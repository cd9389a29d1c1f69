"""The diagnosis of any residual: noise and table of models against dense algebra and enumeration, and known causes."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal, norm

from estimator import Axis, Candidate, diagnose_residual
from estimator.answers.diagnosis import Verdict
from estimator.components.folds import left_out
from estimator.components.formula import Variable, best_formula, judged, units_of
from estimator.components.model_table import WINDOW, TermGroup, weigh
from estimator.components.set_likelihood import SetLikelihood, term_columns_of
from estimator.errors import InputError
from estimator.residual.inputs import checked
from estimator.residual.noise import Noise, Scales, fit_noise
from estimator.residual.shares import held_out
from estimator.residual.terms import ResidualLikelihood, ResidualTerm, terms_of

N = 1200
T = np.arange(N) * 0.5
SCALES = Scales(1.0, 0.8, 3.0)


def smooth(rng, memory):
    return Noise(T, Scales(1e-3, 1.0, memory)).draw(rng)


def world(seed, sizes=None, extra=0.0):
    """Residual, candidates and options of a record with causes of ``sizes``, noise of SCALES, and ``extra`` (n,)."""
    rng = np.random.default_rng(seed)
    x, z = smooth(rng, 10.0), smooth(rng, 30.0)
    candidates = {
        "slide": Candidate(x, 0.3),
        "drag": Candidate(np.abs(x) * x, 0.2, positive=True, unit="N s^2/m^2"),
        "step": Candidate((T > 350) * 1.0, 1.0),
        "product": Candidate(x * z, 0.3),
    }
    residual = Noise(T, SCALES).draw(rng) + extra * x**3
    for name, size in (sizes or {}).items():
        residual = residual + size * candidates[name].column
    options = {"base": np.column_stack([np.ones(N), np.sin(T / 25)]), "along": {"x": Axis(x, "m"), "z": Axis(z, "s")}}
    return residual, candidates, options


def diagnosed(seed, sizes=None, extra=0.0, **more):
    residual, candidates, options = world(seed, sizes, extra)
    return diagnose_residual(residual, candidates, T, rng=np.random.default_rng(1), unit="m/s^2", **options, **more)


def dense(t, scales):
    slow = scales.slow**2 * np.exp(-np.abs(t[:, None] - t) / scales.memory)
    return slow + scales.white**2 * np.eye(len(t))


@pytest.mark.slow
def test_the_noise_is_that_of_the_dense_covariance():
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 40, 60))
    K, Y = dense(t, SCALES), rng.normal(size=(60, 3))
    noise = Noise(t, SCALES)
    assert_allclose(noise.gram(Y), Y.T @ np.linalg.solve(K, Y), rtol=1e-9)
    assert noise.log_determinant == pytest.approx(np.linalg.slogdet(K)[1])
    draws = np.array([noise.draw(rng) for _ in range(4000)])
    assert_allclose(np.cov(draws.T), K, atol=0.15)


def test_the_scales_of_the_noise_come_back():
    t = np.arange(6000) * 0.5
    record = Noise(t, SCALES).draw(np.random.default_rng(5))

    def log_evidence(noise):
        return -0.5 * float(noise.gram(record[:, None])[0, 0]) - 0.5 * noise.log_determinant

    found = fit_noise(t, float(record.std()), log_evidence)
    assert_allclose([found.white, found.slow, found.memory], [1.0, 0.8, 3.0], rtol=0.15)


def enumerated(groups: list[TermGroup]) -> Iterator[tuple[int, ...]]:
    """All sets with at most one term of each group."""
    terms = [term for group in groups for term in group.terms]
    of = {term: group.name for group in groups for term in group.terms}
    for size in range(len(groups) + 1):
        for own in combinations(terms, size):
            if len({of[term] for term in own}) == size:
                yield own


def test_the_table_is_that_of_all_sets():
    rng = np.random.default_rng(4)
    X = rng.normal(size=(80, 5))
    X[:, 1] += X[:, 0]
    y = 0.5 * X[:, 0] + 0.3 * X[:, 3] + rng.normal(size=80)
    terms = [ResidualTerm(name=str(i), columns=X[:, [i]], sd=0.7, positive=i == 3, cost=0.1 * i) for i in range(5)]
    data = np.column_stack([y, X])
    likelihood = SetLikelihood(data.T @ data, np.zeros(0), terms, term_columns_of(0, [1] * 5), np.ones(5))
    groups = [
        TermGroup(name="a", is_named=True, terms=(0, 1), log_odds=-1.0, log_count=np.log(2)),
        *(TermGroup(name=str(i), is_named=True, terms=(i,), log_odds=-2.0, log_count=0.0) for i in (2, 3, 4)),
    ]
    prior = {term: group.log_prior for group in groups for term in group.terms}
    log = {own: likelihood.log_evidence(own) + sum(prior[term] for term in own) for own in enumerated(groups)}
    weights = {own: np.exp(value - max(log.values())) for own, value in log.items()}
    table = weigh(likelihood, groups)
    for group in groups:
        exact = sum(w for own, w in weights.items() if set(own) & set(group.terms)) / sum(weights.values())
        assert table.probability_of_any(group.terms) == pytest.approx(exact, abs=2e-3)
    assert table.probability_of_none == pytest.approx(weights[()] / sum(weights.values()), abs=2e-3)


def test_what_explains_most_alone_is_exchanged_for_what_explains_more_beside_others():
    rng = np.random.default_rng(6)
    first, second, other = rng.normal(size=(3, 200))
    X = np.column_stack([first, second, first + 0.7 * second + 0.3 * other])
    y = 8 * (first + second) + rng.normal(size=200)
    terms = [ResidualTerm(name=str(i), columns=X[:, [i]], sd=10.0) for i in range(3)]
    data = np.column_stack([y, X])
    likelihood = SetLikelihood(data.T @ data, np.zeros(0), terms, term_columns_of(0, [1] * 3), np.ones(3))
    groups = [TermGroup(name=str(i), is_named=True, terms=(i,), log_odds=-1.0, log_count=0.0) for i in range(3)]
    alone = [likelihood.log_evidence([i]) for i in range(3)]
    assert alone[2] > max(alone[:2]) + WINDOW
    assert weigh(likelihood, groups, max_terms=2).best == (0, 1)


def test_two_that_explain_most_together_and_little_alone_are_kept_from_the_set_before():
    rng = np.random.default_rng(7)
    first, second, third, *errors = rng.normal(size=(5, 400))
    X = np.column_stack([5 * third, first + second - 5 * third, first + 0.3 * errors[0], second + 0.3 * errors[1]])
    y = 8 * (first + second) + rng.normal(size=400)
    terms = [ResidualTerm(name=str(i), columns=X[:, [i]], sd=10.0) for i in range(4)]
    data = np.column_stack([y, X])
    likelihood = SetLikelihood(data.T @ data, np.zeros(0), terms, term_columns_of(0, [1] * 4), np.ones(4))
    groups = [TermGroup(name=str(i), is_named=True, terms=(i,), log_odds=-1.0, log_count=0.0) for i in range(4)]
    assert likelihood.log_evidence([0, 1]) > likelihood.log_evidence([2, 3]) + WINDOW
    assert weigh(likelihood, groups, max_terms=2).best == (2, 3)
    assert weigh(likelihood, groups, max_terms=2, starts=[(0, 1)]).best == (0, 1)


def test_evidence_is_that_of_the_dense_density_and_of_quadrature():
    """Against log N(y; 0, K + X P X'); half a prior by a sum over magnitudes; gains against differences of sets."""
    rng = np.random.default_rng(8)
    n, wide = 60, 1e3
    t = np.sort(rng.uniform(0, 40, n))
    K, X = dense(t, SCALES), rng.normal(size=(n, 4))
    X[:, 3] += 0.7 * X[:, 1]
    y = 3 * X[:, 0] + 0.4 * X[:, 1] - 0.1 * X[:, 2] + SCALES.white * rng.normal(size=n)
    terms = [ResidualTerm(name=str(i), columns=X[:, [i]], sd=0.3 + 0.2 * i, positive=i == 2) for i in (1, 2, 3)]
    noise = Noise(t, SCALES)
    data = np.column_stack([y, X])
    likelihood = SetLikelihood(noise.gram(data), np.array([wide**-2]), terms, term_columns_of(1, [1] * 3), np.ones(4))

    def density(others, rest=y):
        covariance = K + wide**2 * np.outer(X[:, 0], X[:, 0])
        for i in others:
            covariance = covariance + terms[i].sd ** 2 * terms[i].columns @ terms[i].columns.T
        return float(multivariate_normal(cov=covariance).logpdf(rest))

    plain = density([])
    for own in ((0,), (2,), (0, 2)):
        assert likelihood.log_evidence(own) - likelihood.log_evidence([]) == pytest.approx(density(own) - plain)
    magnitudes = np.arange(0.0005, 4, 0.001)
    prior = 2 * norm(0, terms[1].sd).pdf(magnitudes)
    likely = np.exp([density([0], y - b * X[:, 2]) - plain for b in magnitudes[::10]])
    half = float(np.log(np.sum(np.interp(magnitudes, magnitudes[::10], likely) * prior) * 0.001))
    assert likelihood.log_evidence([0, 1]) - likelihood.log_evidence([]) == pytest.approx(half, abs=2e-3)
    for other in (1, 2):
        gain = likelihood.log_evidence((0, other)) - likelihood.log_evidence([0])
        assert likelihood.gains([0], [other]).gain[0] == pytest.approx(gain)
    gain, value, sd = judged(
        *likelihood.eliminated([0], noise.gram(np.column_stack([y, X[:, :2], terms[2].sd * X[:, 3]])))
    )
    same = likelihood.gains([0], [2])
    assert (gain[0], terms[2].sd * value[0], terms[2].sd * sd[0]) == pytest.approx(
        (same.gain[0], same.value[0], same.sd[0])
    )


@pytest.mark.slow
def test_a_cause_is_named_with_its_size_and_its_share():
    found = diagnosed(3, {"slide": 0.9})
    assert (found.verdict, found.named, found.between) == (Verdict.EFFECT, ("slide",), ())
    suspect = found.suspects[0]
    assert suspect.name == "slide"
    assert abs(suspect.value - 0.9) < 2.5 * suspect.sd
    assert sum(part.share for part in found.budget) == pytest.approx(1.0)
    part = found.part("slide")
    assert part.q05 < part.share < part.q95
    assert part.held_out_rms == pytest.approx(found.held_out_rms)
    assert part.held_out_rms < found.rms
    assert found.noise == pytest.approx(np.hypot(1.0, 0.8), rel=0.1)
    assert found.where[0].axis == "x"
    with pytest.raises(KeyError):
        found.part("no such cause")


@pytest.mark.slow
def test_shares_are_those_of_the_truth():
    residual, candidates, options = world(11, {"slide": 0.6, "step": -1.5})
    record = checked(residual, candidates, T, options["base"], options["along"])
    rest = record.off_base(residual)
    found = diagnosed(11, {"slide": 0.6, "step": -1.5})
    assert set(found.named) == {"slide", "step"}
    for name, size in (("slide", 0.6), ("step", -1.5)):
        true = rest @ record.off_base(size * candidates[name].column) / (rest @ rest)
        part = found.part(name)
        assert part.share == pytest.approx(true, abs=0.08)
        assert part.q05 - 0.05 < true < part.q95 + 0.05


@pytest.mark.slow
def test_causes_of_one_course_cannot_be_told_apart():
    residual, candidates, options = world(3, {"slide": 0.9})
    candidates["skid"] = Candidate(-2.0 * candidates["slide"].column, 0.15)
    found = diagnose_residual(residual, candidates, T, rng=np.random.default_rng(1), **options)
    assert found.verdict is Verdict.CANNOT_TELL
    assert set(found.between) == {"slide", "skid"}


def test_what_the_base_can_fit_is_no_gap():
    residual, candidates, options = world(8)
    bent = residual + 40 * options["base"][:, 1] - 3
    found = diagnose_residual(bent, candidates, T, rng=np.random.default_rng(1), **options)
    assert found.verdict is Verdict.NO_GAP
    assert found.rms < 1.5


@pytest.mark.slow
def test_what_has_no_name_is_unknown_and_gets_a_formula():
    residual, candidates, options = world(6, extra=0.6)
    others = {name: candidates[name] for name in ("step", "product")}
    found = diagnose_residual(residual, others, T, rng=np.random.default_rng(1), unit="m/s^2", **options)
    assert found.verdict is Verdict.UNKNOWN
    assert found.named == ()
    assert found.unknown > 0.95
    assert found.formula is not None
    assert (found.formula.text, found.formula.unit) == ("x^3", "1/m^2/s^2")
    assert abs(found.formula.value - 0.6) < 3 * found.formula.sd
    assert found.formula.held_out_rms < 0.9 * found.rms


@pytest.mark.nightly
@pytest.mark.slow
def test_noise_is_rarely_given_a_name():
    verdicts = [diagnosed(100 + seed) for seed in range(40)]
    wrong = [found for found in verdicts if found.named or found.verdict is Verdict.UNKNOWN]
    assert verdicts[0].max_false_alarms < 0.04
    assert len(wrong) <= 3  # 40 x 0.03 expected at most: four or more have a probability below 4 %


@pytest.mark.nightly
@pytest.mark.slow
def test_magnitudes_are_covered():
    rng = np.random.default_rng(12)
    inside = 0
    for seed in range(40):
        size = rng.normal(0, 0.3)
        suspect = next(s for s in diagnosed(500 + seed, {"product": size}).suspects if s.name == "product")
        inside += abs(suspect.value - size) < 1.645 * suspect.sd
    assert 31 <= inside <= 40  # of 36 expected


@pytest.mark.slow
def test_surrogates_give_a_p_value():
    assert diagnosed(3, {"slide": 0.9}, surrogates=4).p_value == pytest.approx(0.2)
    assert diagnosed(9, surrogates=4).p_value > 0.2
    assert diagnosed(9).p_value is None


def test_residuals_left_out_are_those_of_fits_without_them():
    residual, candidates, options = world(3, {"slide": 0.9})
    record = checked(residual, candidates, T, options["base"], options["along"])
    term = terms_of(record)[0][0]
    left = np.empty(N)
    for out in left_out(N, 5, N // 20):
        X = np.column_stack([record.base, term.columns])
        K = dense(T[~out], SCALES)
        precision = np.diag([0.0, 0.0, term.sd**-2.0])
        KX = np.linalg.solve(K, X[~out])
        b = np.linalg.solve(X[~out].T @ KX + precision, KX.T @ residual[~out])
        left[out] = residual[out] - X[out] @ b
    assert held_out(record, [term], SCALES) == pytest.approx(np.sqrt(np.mean(left**2)))


def test_rows_of_a_likelihood_are_those_that_it_is_given():
    residual, candidates, options = world(3)
    record = checked(residual, candidates, T, None, options["along"])
    rows = np.arange(0, N, 2)
    part = replace(record, t=T[rows], residual=residual[rows], base=record.base[rows])
    terms = [ResidualTerm(name="slide", columns=candidates["slide"].column[:, None], sd=0.3)]
    halved = [replace(terms[0], columns=terms[0].columns[rows])]
    noise = Noise(T[rows], SCALES)
    one, other = ResidualLikelihood(record, terms, noise, rows), ResidualLikelihood(part, halved, noise)
    assert one.log_evidence([0]) == other.log_evidence([0])


def test_the_best_formula_is_found_among_all():
    rng = np.random.default_rng(3)
    v, w = rng.uniform(1, 9, 400), rng.normal(size=400)
    y = 0.7 * w * np.abs(w) / v + rng.normal(0, 0.05, 400)

    def judge(columns):
        return judged(columns.T @ columns / 0.05**2, columns.T @ y / 0.05**2)

    found = best_formula({"v": Variable(v, "m/s"), "w": Variable(w, "rad")}, "N", float(y.std()), judge)
    assert (found.text, found.unit) == ("v^-1 w |w|", "N m/s/rad^2")
    assert found.value == pytest.approx(0.7, abs=0.02)
    assert_allclose(found.column, w * np.abs(w) / v)
    assert best_formula({"v": Variable(np.ones(5), "m")}, "N", 1.0, judge) is None


@pytest.mark.parametrize(
    ("text", "powers"),
    [
        ("", {}),
        ("1", {}),
        ("m/s^2", {"m": 1, "s": -2}),
        ("kg m^2/s/K", {"kg": 1, "m": 2, "s": -1, "K": -1}),
        ("1/s", {"s": -1}),
        ("m/s^-1", {"m": 1, "s": 1}),
        ("km/h", {"km": 1, "h": -1}),
        ("%", {"%": 1}),
        ("N*m·s", {"N": 1, "m": 1, "s": 1}),
    ],
)
def test_units_are_read(text, powers):
    assert units_of(text) == powers


@pytest.mark.parametrize("text", ["(m/s)^2", "m^0.5", "m^", "^2", "m^2^3"])
def test_a_unit_that_is_no_product_of_powers_is_refused(text):
    with pytest.raises(ValueError, match="no product of whole powers"):
        units_of(text)


BAD = {
    "residual: 50 samples; at least 100": lambda r, c, t: (r[:50], c, t),
    "time: 1199 samples, but the residual has 1200": lambda r, c, t: (r, c, t[1:]),
    "time: does not ascend at index 7": lambda r, c, t: (r, c, np.where(np.arange(N) == 7, 0.0, t)),
    "residual: not finite at index 3": lambda r, c, t: (np.where(np.arange(N) == 3, np.nan, r), c, t),
    "residual: zero everywhere": lambda r, c, t: (0 * r, c, t),
    "column 'slide': zero everywhere": lambda r, c, t: (r, c | {"slide": Candidate(0 * r, 1.0)}, t),
    "time: hardly ascends at index 8": lambda r, c, t: (r, c, np.where(np.arange(N) == 8, np.nextafter(t[7], 9e9), t)),
    "time: holds what is no real number": lambda r, c, t: (r, c, np.datetime64(0, "s") + t.astype("timedelta64[s]")),
    "residual: holds what is no real number": lambda r, c, t: (["a"] * N, c, t),
    "residual: the largest value is": lambda r, c, t: (1e200 * r, c, t),
    "column 'sensor noise': the answer uses this name": lambda r, c, t: (r, {"sensor noise": c["slide"]}, t),
    "column 'unknown over x': the answer uses": lambda r, c, t: (r, {"unknown over x": c["slide"]}, t),
    "column 'slide': is no Candidate": lambda r, c, t: (r, {"slide": r}, t),
    "sd of column 'slide': not finite": lambda r, c, t: (r, {"slide": Candidate(r, np.inf)}, t),
    "column 'slide': sd is 0.0": lambda r, c, t: (r, c | {"slide": Candidate(r, 0.0)}, t),
    "column 'slide': 5 samples": lambda r, c, t: (r, c | {"slide": Candidate(r[:5], 1.0)}, t),
    "column 'slide': has 2 dimensions; 1 expected": lambda r, c, t: (r, c | {"slide": Candidate(r[:, None], 1.0)}, t),
}


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_used_is_named(message):
    residual, candidates, options = world(1)
    r, c, t = BAD[message](residual, candidates, T)
    with pytest.raises(InputError, match=message):
        diagnose_residual(r, c, t, rng=np.random.default_rng(1), **options)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"base": np.ones((N, 2))}, "base: its columns are not independent"),
        ({"base": np.ones(N)}, "base: has 1 dimensions; 2 expected"),
        ({"base": np.random.default_rng(1).normal(size=(N, N // 2 + 1))}, "base: 601 columns for 1200 samples"),
        ({"base": world(1)[0][:, None]}, "residual: the base explains all of it"),
        ({"along": {"x": Axis(T[:4])}}, "along 'x': 4 samples"),
        ({"along": {"x": T}}, "along 'x': is no Axis"),
        ({"along": {"time": Axis(T)}}, "along 'time': time is always an axis"),
        ({"along": {"": Axis(T)}}, "along '': has no name"),
        ({"along": {"x": Axis(T, "m^0.5")}}, "along 'x': the unit"),
        ({"unit": "(m/s)^2"}, "unit: the unit"),
        ({"surrogates": -1}, "surrogates: -1"),
        ({"rng": 1}, "rng: is no generator"),
    ],
)
def test_a_base_or_an_axis_that_cannot_be_used_is_named(more, message):
    residual, candidates, _ = world(1)
    with pytest.raises(InputError, match=message):
        diagnose_residual(residual, candidates, T, **({"rng": np.random.default_rng(1)} | more))


@pytest.mark.slow
def test_what_the_base_holds_does_not_blur_the_rest():
    """A common offset of 1e9, in residual and columns, changes nothing; a candidate in the base keeps its prior."""
    residual, candidates, options = world(3, {"slide": 0.9})
    plain = diagnosed(3, {"slide": 0.9})
    lifted = {name: replace(c, column=c.column + 1e6) for name, c in candidates.items()}
    lifted["offset"] = Candidate(np.full(N, 3.0), 1e9)
    found = diagnose_residual(residual + 1e9, lifted, T, rng=np.random.default_rng(1), **options)
    assert found.named == plain.named == ("slide",)
    assert (found.rms, found.noise) == pytest.approx((plain.rms, plain.noise), rel=1e-3)
    offset = next(suspect for suspect in found.suspects if suspect.name == "offset")
    assert (offset.value, offset.hidden) == (0, 0)
    assert offset.probability < 0.2


@pytest.mark.slow
def test_parameters_that_one_stretch_alone_shows_are_fitted():
    residual, candidates, options = world(3, {"slide": 0.9})
    first = np.column_stack([np.ones(N), np.arange(N) < N // 20, 1 + 1e-8 * np.sin(T)])
    found = diagnose_residual(residual, candidates, T, rng=np.random.default_rng(1), **options | {"base": first})
    assert found.named == ("slide",)
    assert found.held_out_rms < found.rms


def test_an_axis_of_two_values_has_two_places():
    switch = np.arange(N) % 40 < 13
    residual = world(1)[0] + 1.5 * switch
    options = {"base": np.ones((N, 1)), "along": {"switch": Axis(switch)}}
    found = diagnose_residual(residual, {}, T, rng=np.random.default_rng(1), **options)
    places = {(place.start, place.end): place.bias for place in found.where if place.axis == "switch"}
    assert set(places) == {(0.0, 0.0), (1.0, 1.0)}
    assert places[1.0, 1.0] == pytest.approx(1.5, abs=0.4)


@pytest.mark.slow
def test_two_candidates_without_noise_leave_nothing_unknown():
    """A process may stand for one of them until both are in the set."""
    _, candidates, options = world(3)
    residual = 0.7 * candidates["slide"].column + 0.8 * candidates["drag"].column + 3
    found = diagnose_residual(residual, candidates, T, rng=np.random.default_rng(1), **options)
    assert set(found.named) == {"slide", "drag"}
    assert found.unknown < 0.5
    assert found.part("drag").share > 0.1


@pytest.mark.slow
def test_twins_of_wide_priors_cannot_be_told_apart():
    _, candidates, options = world(3)
    column = candidates["slide"].column
    twins = {"one": Candidate(column, 1e3), "other": Candidate(-column, 1e3)}
    found = diagnose_residual(0.7 * column, twins, T, rng=np.random.default_rng(1), **options)
    assert (found.verdict, set(found.between)) == (Verdict.CANNOT_TELL, {"one", "other"})
    assert [abs(suspect.value) for suspect in found.suspects] == pytest.approx([0.7, 0.7], abs=0.1)


@pytest.mark.slow
def test_a_magnitude_that_cannot_be_negative_is_not():
    residual, candidates, options = world(3, {"drag": -0.5})
    drag = {"drag": candidates["drag"]}
    assert diagnose_residual(residual, drag, T, rng=np.random.default_rng(1), **options).suspects[0].value > 0


def test_a_catalogue_may_be_empty():
    residual, _, _ = world(1)
    found = diagnose_residual(residual, {}, T, rng=np.random.default_rng(1))
    assert (found.verdict, found.suspects) == (Verdict.NO_GAP, ())
