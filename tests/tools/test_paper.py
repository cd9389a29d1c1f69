"""The paper's printed numbers beside computed ones: Table 5, the hierarchical fit and the figures that are kept."""

import json

import numpy as np
import pytest
from project_paths import ROOT
from scipy.special import logsumexp

from estimator.errors import InputError


@pytest.fixture
def parts():
    from paper.cycles import all_parts

    try:
        return all_parts()
    except (FileNotFoundError, InputError):
        pytest.skip("no tables of HHDDTNC: set ROADLOAD_DATA to the folder of recordings")


def kept(table):
    """Records of a table in results/paper.json."""
    return json.loads((ROOT / "results" / "paper.json").read_bytes())["figures"][table]


def assert_same(computed, stored, rel):
    """Require the same words, and numbers to within ``rel``."""
    assert [list(record) for record in computed] == [list(record) for record in stored]
    for new, old in zip(computed, stored, strict=True):
        for name, value in new.items():
            assert value == (value if old[name] == value else pytest.approx(old[name], rel=rel, abs=1e-6)), name


def test_cycles_are_those_described():
    from paper.cycles import cycles_of, shipped_parts
    from paper.vehicles import MPH

    hwfet, commut = cycles_of(shipped_parts()).values()
    assert (commut.duration, commut.v.max() / MPH) == (330, pytest.approx(55))
    assert commut.miles == pytest.approx(4.0, abs=0.005)
    assert (hwfet.duration, hwfet.v.max() / MPH) == (766, pytest.approx(59.9))
    assert hwfet.miles == pytest.approx(10.26, abs=0.005)


def test_printed_tables_agree_with_each_other():
    """Table 1 is the mean and sd of Tables 2-4, to its digits; the sd of m on HWFET is not (4.86 for 5.02)."""
    from paper.printed import PRINTED

    for cycle in PRINTED.values():
        digits = np.array([1.0, 0.001, 1.0])
        assert (np.abs(cycle.estimates.mean(axis=0) - cycle.mean) <= digits).all()
        sd = cycle.estimates.std(axis=0, ddof=1)
        assert sd == pytest.approx(cycle.sd, rel=0.13, abs=0.0005)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["HWFET", pytest.param("COMMUT", marks=pytest.mark.nightly)])
def test_dummy_case_is_recovered_from_anywhere_in_the_box(name):
    from paper.cycles import cycles_of, shipped_parts
    from paper.experiments import dummy_case
    from paper.vehicles import DUMMY

    (mean, sd), (frozen, _) = dummy_case(cycles_of(shipped_parts())[name])
    assert mean == pytest.approx(DUMMY, rel=1e-4)
    assert (sd < 1e-3 * DUMMY).all()
    assert frozen == pytest.approx(DUMMY, rel=0.02)


@pytest.mark.slow
def test_both_kernels_recover_a_noisy_truck():
    from paper.cycles import cycles_of, shipped_parts
    from paper.estimation import Drive, estimate
    from paper.vehicles import NOMINAL

    kept = Drive.of(cycles_of(shipped_parts())["HWFET"], NOMINAL, 2e3, (1,)).positive()
    walk, independent = (estimate(kept, (0,), kernel) for kernel in ("random_walk", "independence"))
    assert (np.abs(walk.mean - NOMINAL) < 4 * walk.sd).all()
    assert (walk.sd < 0.02 * NOMINAL).all()
    assert walk.r_hat < 1.02
    assert (np.abs(walk.mean - independent.mean) < 0.2 * walk.sd).all()
    assert walk.sd == pytest.approx(independent.sd, rel=0.1)


def test_table_five_on_the_shipped_cycles():
    """P in lbf ft/s and m in slug, on the schedules as they are: printed eigenvalues of HWFET and COMMUT."""
    from paper.cycles import shipped_parts
    from paper.table_five import Processing, Units, compare, raw_information

    processing = Processing()
    information = {name: raw_information(name, v, processing) for name, v in shipped_parts().items()}
    match = compare(information, processing, Units(mass="slug", power="lbf ft/s", factor="JᵀJ"))
    assert match.log10_eigenvalues[0] == pytest.approx([13.41, 5.80, 4.94], abs=0.09)
    assert match.log10_eigenvalues[1, :2] == pytest.approx([13.12, 5.348], abs=0.10)
    assert match.nearest.tolist() == [[1, 2, 0], [1, 2, 0]]  # C, m, A
    assert match.angles[:, 1] == pytest.approx([0.020, 0.0195], abs=0.0005)
    assert match.angles[:, 0] == pytest.approx(match.angles[:, 2], abs=0.01)


def test_printed_information_has_the_printed_eigen_metrics():
    from paper.printed import PRINTED
    from paper.table_five import printed_information

    from estimator.sampling.identifiability import eigen_metrics

    for cycle in PRINTED.values():
        metrics = eigen_metrics(printed_information(cycle))
        assert metrics.log10_eigenvalues == pytest.approx(cycle.log10_eigenvalues, abs=1e-6)
        A, C, m = metrics.angles.min(axis=0)
        assert (A, m, C) == pytest.approx(tuple(cycle.angles), abs=1e-3)


@pytest.mark.slow
def test_the_search_for_table_five_is_what_is_kept(parts):
    from paper import summary
    from paper.table_five import search

    matches, names = search(parts), list(parts)
    assert_same(summary.table_five(matches, names), kept("Table 5"), rel=1e-6)
    assert_same(summary.units(matches), kept("Table 5, units"), rel=1e-6)
    assert_same(summary.choices(matches), kept("Table 5, one choice at a time"), rel=1e-6)
    assert_same(summary.column_order(matches[0], names), kept("Table 5, order of its columns"), rel=1e-6)


@pytest.mark.slow
def test_the_first_run_of_each_cycle_is_what_is_kept(parts):
    from paper.cycles import cycles_of
    from paper.experiments import run_estimate
    from paper.summary import PARAMETERS, run_row

    rows = {row["run"]: row for row in kept("Tables 2 to 4")}
    for name, cycle in cycles_of(parts).items():
        row = run_row(name, 0, run_estimate(cycle, 0))
        old = rows[row["run"]]
        for key in PARAMETERS:
            (mean, sd), (old_mean, old_sd) = row[f"{key}, here"], old[f"{key}, here"]
            assert mean == pytest.approx(old_mean, abs=0.2 * sd)
            assert sd == pytest.approx(old_sd, rel=0.15)
            assert row[key] == old[key]
        assert row["rms [hp], here"] == pytest.approx(old["rms [hp], here"], abs=0.001)


def test_levenes_test_and_the_scatter_of_the_printed_runs_are_what_is_kept():
    from paper.experiments import levene_tests, white_noise_covariance
    from paper.printed import PRINTED
    from paper.summary import levene, parameters

    tests = levene_tests({name: cycle.estimates for name, cycle in PRINTED.items()})
    assert_same(levene(tests, tests)[:1], kept("Levene's test between cycles")[:1], rel=1e-6)
    for name, cycle in PRINTED.items():
        white = np.sqrt(np.diagonal(white_noise_covariance(name).mean(axis=0)))
        for label, sd in (("printed runs, sd", cycle.estimates.std(axis=0, ddof=1)), ("white noise", white)):
            (row,) = (x for x in kept("Scatter between runs") if x["cycle"] == name and x["spread"].startswith(label))
            assert parameters(sd) == pytest.approx({key: row[key] for key in parameters(sd)}, rel=1e-6)


@pytest.mark.slow
def test_the_hierarchical_fit_is_what_is_kept(parts):
    """Sampled, so means and intervals may differ by 4 % between machines."""
    from paper import summary
    from paper.cycles import cycles_of
    from paper.vehicle_posterior import BETWEEN_PRIORS, vehicle_posterior

    cycles = cycles_of(parts)
    posterior = vehicle_posterior(cycles, BETWEEN_PRIORS[0])
    vehicle = summary.vehicle({BETWEEN_PRIORS[0]: posterior}, list(cycles))
    stored = [x for x in kept("Hierarchical fit") if x["parameters of"] in {row["parameters of"] for row in vehicle}]
    assert_same(vehicle, stored, rel=0.04)
    assert_same(summary.between_runs(posterior, cycles), kept("Hierarchical fit, runs"), rel=0.04)


def random_runs(rng, cycles=3, runs=4, p=3):
    from paper.hierarchy import CycleRuns

    def covariance(*shape):
        root = rng.standard_normal((*shape, p, p))
        return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(p)

    return [
        CycleRuns(
            y=rng.standard_normal((runs + c, p)),
            noise=covariance(runs + c),
            offset=rng.standard_normal(p),
            rounding=0.01 * np.eye(p),
        )
        for c in range(cycles)
    ]


def dense_moments(cycles, kappa, tau, beta):
    """Joint Gaussian of all estimates: log density with a flat mu, and the mean and covariance of mu."""
    p = len(beta)
    y = np.concatenate([cycle.y.ravel() for cycle in cycles])
    X = np.tile(np.eye(p), (len(y) // p, 1))
    V = np.zeros((len(y), len(y)))
    start = 0
    for cycle, k in zip(cycles, kappa, strict=True):
        n = len(cycle.y)
        block = np.kron(np.ones((n, n)), np.diag(beta**2))
        for i in range(n):
            own = k**2 * cycle.noise[i] + tau**2 * np.outer(cycle.offset, cycle.offset) + cycle.rounding
            block[i * p : (i + 1) * p, i * p : (i + 1) * p] += own
        V[start : start + n * p, start : start + n * p] = block
        start += n * p
    precision = X.T @ np.linalg.solve(V, X)
    mu = np.linalg.solve(precision, X.T @ np.linalg.solve(V, y))
    residual = y - X @ mu
    density = residual @ np.linalg.solve(V, residual)
    density += np.linalg.slogdet(V)[1] + np.linalg.slogdet(precision)[1]
    return -0.5 * density, mu, np.linalg.inv(precision)


def test_closed_form_of_the_hierarchical_model_is_the_dense_gaussian():
    from paper.hierarchy import conditional

    rng = np.random.default_rng(1)
    cycles = random_runs(rng)
    kappa, tau, beta = (np.exp(rng.standard_normal(shape)) for shape in ((5, 3), (5,), (5, 3)))
    given = conditional(cycles, kappa, tau, beta)
    dense = [dense_moments(cycles, *hyper) for hyper in zip(kappa, tau, beta, strict=True)]
    # The log marginals agree up to a constant.
    assert np.diff(given.log_marginal) == pytest.approx(np.diff([d[0] for d in dense]), abs=1e-8)
    for i, (_, mu, covariance) in enumerate(dense):
        assert given.mean[i] == pytest.approx(mu, abs=1e-9)
        assert np.linalg.inv(given.precision[i]) == pytest.approx(covariance, abs=1e-9)


@pytest.mark.slow
def test_sampled_hierarchical_model_agrees_with_a_grid():
    """One parameter, two cycles: kappa_1, kappa_2, tau, beta and mu integrated on a grid, theta_1 in closed form."""
    from paper.hierarchy import HyperparameterTarget, Prior, conditional, fit

    rng = np.random.default_rng(2)
    cycles = random_runs(rng, cycles=2, runs=6, p=1)
    prior = Prior(tau=1.0, beta=np.array([2.0]))
    axis = np.linspace(-4.0, 4.0, 17)
    grid = np.stack(np.meshgrid(axis, axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 4)
    target = HyperparameterTarget(cycles, prior)
    log_weight = target.log_density(grid)
    weight = np.exp(log_weight - logsumexp(log_weight))
    given = conditional(cycles, *target.split(grid))
    mean = float(weight @ given.mean[:, 0])
    variance = float(weight @ (1 / given.precision[:, 0, 0] + given.mean[:, 0] ** 2)) - mean**2
    between = target.split(grid)[2][:, 0] ** 2
    shrunk = between / (between + given.cycle_covariance[:, 0, 0, 0])
    theta = float(weight @ (given.mean[:, 0] + shrunk * (given.cycle_mean[:, 0, 0] - given.mean[:, 0])))

    sampled = fit(cycles, prior, np.random.default_rng(3))
    assert sampled.r_hat < 1.02
    assert sampled.mu.mean() == pytest.approx(mean, abs=0.05 * variance**0.5)
    assert sampled.mu.std() == pytest.approx(variance**0.5, rel=0.06)
    assert sampled.theta[:, 0, 0].mean() == pytest.approx(theta, abs=0.05 * variance**0.5)
    kappa, tau, beta = target.split(grid)
    for draws, values in ((sampled.kappa, kappa), (sampled.tau[:, None], tau[:, None]), (sampled.beta, beta)):
        expected = weight @ values
        sd = np.sqrt(weight @ (values - expected) ** 2)
        assert (np.abs(draws.mean(axis=0) - expected) < 0.1 * sd).all()
        assert draws.std(axis=0) == pytest.approx(sd, rel=0.1)
