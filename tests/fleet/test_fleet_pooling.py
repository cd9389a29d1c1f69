"""What drives of a vehicle share, and vehicles of a fleet: known truth is recovered, intervals cover it."""

from datetime import UTC, datetime

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal, norm

from estimator.estimation.evidence import Coefficients
from estimator.false_discovery import false_discovery_rates
from estimator.fleet.grouping import YEAR
from estimator.fleet.over_time import NOW, PRIOR_SD, TREND, newest, terms, winter, years_since
from estimator.fleet.pooling import Mixture, pool
from estimator.fleet.population import population
from estimator.fleet.vehicles import VehicleResult, join
from estimator.settings import Gate

TRUTH = np.array([0.065, 3.7])  # A/m, C


def drives(rng: np.random.Generator, n: int, scatter: float) -> tuple[np.ndarray, np.ndarray]:
    """Estimates of drives that scatter by a share of the truth more than their own sd."""
    theta = TRUTH * (1 + scatter * rng.standard_normal((n, 2)))
    sd = 0.08 * TRUTH * rng.uniform(0.3, 2, (n, 1))
    V = sd[:, :, None] * np.array([[1, -0.85], [-0.85, 1]]) * sd[:, None, :]
    return np.array([rng.multivariate_normal(*one) for one in zip(theta, V, strict=True)]), V


@pytest.mark.slow
@pytest.mark.parametrize(("scatter", "least"), [(0.0, 0.87), (0.05, 0.87), (0.15, 0.8)])  # the prior's scale is 0.1
def test_intervals_of_what_drives_share_cover_the_truth(scatter: float, least: float) -> None:
    rng = np.random.default_rng(1)
    shared, coming = [], []
    for _ in range(150):
        z, V = drives(rng, int(rng.integers(2, 13)), scatter)
        pooled = pool(z, V, 0.1, np.zeros(len(z)))
        following = TRUTH * (1 + scatter * rng.standard_normal(2))
        for i in range(2):
            interval = pooled.shared(i).marginal
            shared.append(interval.q05 <= TRUTH[i] <= interval.q95)
            interval = pooled.predicted(i).marginal
            coming.append(interval.q05 <= following[i] <= interval.q95)
    assert np.mean(shared) > least
    assert np.mean(coming) > least


def test_drives_that_scatter_more_than_their_sd_widen_the_interval() -> None:
    V = np.broadcast_to(np.diag((0.01 * TRUTH) ** 2), (6, 2, 2))
    equal = np.tile(TRUTH, (6, 1))
    apart = TRUTH * (1 + 0.1 * np.array([-1.5, -1, -0.5, 0.5, 1, 1.5]))[:, None]
    agreed, scattered = pool(equal, V, 0.1, np.zeros(6)), pool(apart, V, 0.1, np.zeros(6))
    for i in range(2):
        assert scattered.shared(i).marginal.sd > 5 * agreed.shared(i).marginal.sd
        assert scattered.scatter(i) == pytest.approx(0.1 * TRUTH[i], rel=0.35)


def test_the_posterior_is_that_of_numerical_integration() -> None:
    z, V = drives(np.random.default_rng(3), 3, 0.05)
    pooled = pool(z, V, 0.1, np.zeros(3))
    node = int(np.argmax(pooled.weights))
    T, spread = np.diag(pooled.tau[node] ** 2), pooled.covariance[node][:, 0, :, 0]
    axes = [np.linspace(-7, 7, 141) * np.sqrt(spread[i, i]) + pooled.mean[node, i, 0] for i in range(2)]
    mu = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    shown = np.prod([multivariate_normal.pdf(mu, z[i], V[i] + T) for i in range(3)], axis=0)
    shown /= shown.sum()
    mean = np.einsum("ij,ijk->k", shown, mu)
    left = mu - mean
    assert mean == pytest.approx(pooled.mean[node, :, 0], rel=1e-6)
    assert np.einsum("ij,ijk,ijl->kl", shown, left, left) == pytest.approx(spread, rel=1e-6)


def test_trend_and_season_have_the_posterior_of_the_dense_gaussian() -> None:
    rng = np.random.default_rng(8)
    years = np.sort(rng.uniform(-2, 0, 5))
    z, V = drives(rng, 5, 0.05)
    pooled = pool(z, V, 0.1, years)
    node = int(np.argmax(pooled.weights))
    X = np.kron(np.eye(2), terms(years))  # both quantities one after the other
    shown = np.zeros((10, 10))
    for a, b in np.ndindex(2, 2):
        shown[5 * a : 5 * a + 5, 5 * b : 5 * b + 5] = np.diag(V[:, a, b] + (a == b) * pooled.tau[node, a] ** 2)
    weights = np.linalg.inv(shown)
    centre = np.zeros(2)  # the weighted mean, of drives that scatter by a tenth of it
    for _ in range(2):
        own = np.linalg.inv(V + np.diag((0.1 * centre) ** 2))
        centre = np.linalg.solve(own.sum(axis=0), np.einsum("nij,nj->i", own, z))
    spread = np.linalg.inv(X.T @ weights @ X + np.diag(((PRIOR_SD * centre[:, None]) ** -2.0).ravel()))
    mean = (spread @ X.T @ weights @ z.T.ravel()).reshape(2, -1)
    assert pooled.mean[node] == pytest.approx(mean, rel=1e-6, abs=1e-9)
    assert pooled.covariance[node].reshape(8, 8) == pytest.approx(spread, rel=1e-6, abs=1e-10)
    now = pooled.shared(1)
    assert now.marginal.mean == pytest.approx(float(pooled.weights @ pooled.mean[:, 1, 0]))


@pytest.mark.slow
@pytest.mark.parametrize("days", [2.0, 20.0, 45.0])
def test_a_vehicle_that_changes_is_known_as_it_is_now(days: float) -> None:
    """Trend and season as large as their priors say; drives every some days, up to two years and a half."""
    rng = np.random.default_rng(9)
    start = datetime(2024, 3, 1, tzinfo=UTC).timestamp()
    starts = [start + i * days * 86_400.0 for i in range(20)]
    years, share = years_since(starts[-1], starts), winter(starts[-1])
    held = {"now": [], "trend": [], "winter": []}
    for _ in range(60):
        change = PRIOR_SD * TRUTH[:, None] * rng.standard_normal((2, 4))
        change[:, 0] = TRUTH
        z, V = drives(rng, 20, 0.05)
        pooled = pool(z - TRUTH + terms(years) @ change.T, V, 0.1, years)
        for name, of in (("now", NOW), ("trend", TREND), ("winter", share)):
            for i in range(2):
                interval = pooled.combined(i, of).marginal
                held[name].append(interval.q05 <= change[i] @ of <= interval.q95)
    assert all(0.83 < np.mean(inside) < 0.97 for inside in held.values()), held


def test_a_season_is_that_of_the_calendar() -> None:
    now = datetime(2025, 1, 20, tzinfo=UTC).timestamp()
    january, july = terms(np.array([0.0, 0.5])) * [1, 0, 1, 1]
    assert winter(now) == pytest.approx(january - july, abs=0.02)
    assert winter(now + YEAR / 2) == pytest.approx(-winter(now), abs=0.02)


def test_a_clock_that_is_doubted_does_not_date_the_vehicle() -> None:
    now = datetime(2025, 1, 20, tzinfo=UTC).timestamp()
    starts = [now - YEAR, 0.0, now - YEAR / 2, now, now + 25 * YEAR]
    assert newest(starts) == now
    assert years_since(now, starts).tolist() == pytest.approx([-1.0, 0.0, -0.5, 0.0, 0.0])
    assert newest([0.0, 100.0]) is None
    assert years_since(None, [0.0, 100.0]).tolist() == [0.0, 0.0]


def test_quantiles_of_a_mixture_of_one_are_those_of_a_normal_distribution() -> None:
    marginal = Mixture(np.array([1.0]), np.array([3.0]), np.array([0.5])).marginal
    assert (marginal.mean, marginal.sd) == pytest.approx((3.0, 0.5))
    assert (marginal.q05, marginal.q95) == pytest.approx(tuple(norm(3.0, 0.5).ppf([0.05, 0.95])))


def load(rng: np.random.Generator, mass: float) -> Coefficients:
    """What a drive shows: 1/m to 1 %, A/m to 10 % and C/m to 6 %, against each other."""
    beta = np.array([1 / mass, TRUTH[0], TRUTH[1] / mass])
    sd = beta * [0.01, 0.1, 0.06]
    covariance = np.outer(sd, sd) * [[1, 0.6, 0.3], [0.6, 1, -0.5], [0.3, -0.5, 1]]
    return Coefficients(rng.multivariate_normal(beta, covariance), covariance)


@pytest.mark.slow
def test_a_vehicle_is_known_better_from_ten_drives_than_from_one_and_each_load_keeps_its_mass() -> None:
    rng = np.random.default_rng(4)
    masses = np.linspace(15_000, 40_000, 10)
    inside = 0
    for _ in range(20):
        loads = [load(rng, mass) for mass in masses]
        one, ten = join("t", loads[:1], [0.0], Gate(), 0.1), join("t", loads, [0.0] * 10, Gate(), 0.1)
        assert one.drag is not None
        assert ten.drag is not None
        assert ten.drag.sd < 0.6 * one.drag.sd
        assert ten.drag.mean == pytest.approx(TRUTH[1], rel=0.12)
        inside += sum(m.q05 <= mass <= m.q95 for m, mass in zip(ten.masses, masses, strict=True))
        alone = join("t", loads[-1:], [0.0], Gate(), 0.1)
        assert ten.masses[-1].sd < alone.masses[0].sd
    assert 0.83 * 200 < inside < 0.97 * 200


def test_vehicles_are_compared_at_one_date() -> None:
    """In July tyres roll more easily: a vehicle that was parked then is not out of line in January."""
    rng, day = np.random.default_rng(11), 86_400.0
    january = 1_705_300_000.0
    starts = january + day * np.arange(0, 365, 5)

    def driven(until: float) -> VehicleResult:
        kept = [start for start in starts.tolist() if start < until]
        loads = []
        for start in kept:
            swing = 1 + 0.06 * np.cos(2 * np.pi * (start - january) / (365.25 * day))
            beta = np.array([1 / 20e3, TRUTH[0] * swing, TRUTH[1] / 20e3])
            sd = beta * [0.003, 0.03, 0.03]
            loads.append(Coefficients(rng.normal(beta, sd), np.diag(sd**2)))
        return join("t", loads, kept, Gate(), 0.1, last=float(starts[-1]))

    parked, whole = driven(january + 183 * day), driven(np.inf)
    assert parked.rolling is not None
    assert whole.rolling is not None
    assert parked.rolling.mean < 0.93 * whole.rolling.mean
    (late, _), (now, _) = parked.compared, whole.compared
    assert late is not None
    assert now == whole.rolling
    assert abs(late.mean - now.mean) < 2 * late.sd
    assert late.sd > 2 * parked.rolling.sd


def test_one_vehicle_that_is_hardly_known_leaves_the_others_their_p_values() -> None:
    rng = np.random.default_rng(3)
    values, sd = 4 * (1 + 0.01 * rng.standard_normal(31)), np.full(31, 0.04)
    values[7] *= 1.03
    known = population(values[:30], sd[:30]).p_values
    sd[30], values[30] = 1.8, 5.5
    assert_allclose(population(values, sd).p_values[:30], known, atol=0.02)


def test_a_vehicle_without_a_known_mass_is_unestimated() -> None:
    result = join("t", [], [], Gate(), 0.1)
    assert result.status == "unestimated"
    assert result.reasons == ("no drive with an estimated mass",) * 2


def test_outliers_are_found_at_the_false_discovery_rate() -> None:
    rng = np.random.default_rng(5)
    found, false_share = 0, []
    for _ in range(30):
        values = 4 * (1 + 0.03 * rng.standard_normal(20))
        values[:2] *= 1.25
        compared = population(values + 0.1 * rng.standard_normal(20), np.full(20, 0.1))
        named = false_discovery_rates(compared.p_values) <= 0.05
        found += int(named[:2].sum())
        false_share.append(named[2:].sum() / max(named.sum(), 1))
    assert found >= 54  # of 60
    assert np.mean(false_share) < 0.1


def test_a_new_vehicle_lies_where_the_usual_ones_do() -> None:
    rng = np.random.default_rng(6)
    values = 4 * (1 + 0.03 * rng.standard_normal(30))
    values[0] = 8.0
    new = population(values, np.full(30, 0.05)).new.marginal
    assert new.mean == pytest.approx(4.0, rel=0.02)
    assert 0.06 < new.sd < 0.25
