"""Three questions before an estimate, each with its reason when the answer is no."""

from collections import Counter

import numpy as np

from estimator.estimates import Coverage
from estimator.estimation.gate import MIN_PULLING_ACCELERATION, Gate, Judged, has_news, wrong_sign_of, wrong_unit_of
from estimator.estimation.window import Grid
from estimator.settings import Gate as GateConfig

THETA = np.array([1739.0, 3.74, 27_190.0])
GRID = Grid(2.5, 0.1)


def gate(**settings) -> Gate:
    return Gate(GateConfig(**settings), GRID)


def fit(theta=THETA, relative=0.01) -> Judged:
    theta = np.asarray(theta, float)
    return Judged(theta, relative * np.abs(theta) + 1e-9)


def counts(v, a) -> np.ndarray:
    return np.bincount(GRID.cell(np.asarray(v, float), np.asarray(a, float)), minlength=GRID.size)


# Enough rows


def test_too_few_rows_are_told_with_the_commonest_of_the_others():
    strict = gate(minimum_samples=1200)
    assert strict.missing_rows(1199, Counter()) == "1199 usable samples of the 1200 needed"
    others = Counter(braking=7, standing=9)
    assert strict.missing_rows(0, others) == "0 usable samples of the 1200 needed; most others: standing"
    assert strict.missing_rows(1200, others) == ""


# Covered


def test_a_fit_that_is_sure_enough_is_covered():
    assert gate().obstacle_to_estimate(fit(), Coverage(20, 60)) == ""


def test_coverage_counts():
    few = gate().obstacle_to_estimate(fit(), Coverage(5, 5))  # 100 % of them would be no reason
    assert few == "coverage 5 of the 8 cells needed (5 can be reached)"
    assert (
        gate().obstacle_to_estimate(fit(), Coverage(8, 100))
        == "coverage 8 % of the reachable speed-acceleration cells (8 of 100)"
    )
    assert gate().obstacle_to_estimate(fit(), Coverage(0, 0)).startswith("coverage 0 %")


def test_an_unsure_fit_is_not_covered():
    assert "sd of mass is 20 %" in gate().obstacle_to_estimate(fit(relative=0.2), Coverage(20, 60))
    assert "sd of A is 60 %" in gate().obstacle_to_estimate(fit(relative=0.6), Coverage(20, 60))
    assert gate(relative_sd=(1.0, 1.0, 1.0)).obstacle_to_estimate(fit(relative=0.6), Coverage(20, 60)) == ""
    assert gate().obstacle_to_estimate(fit(relative=np.nan), Coverage(20, 60)) != ""


def test_constant_speed_covers_one_cell():
    coverage = gate().coverage(counts(np.full(5000, 22.0), np.zeros(5000)), THETA[:3], np.full(5000, 80e3))
    assert coverage.occupied <= 1
    assert gate().obstacle_to_estimate(fit(), coverage) != ""


def test_reachable_cells_need_power_that_was_seen():
    v, a = (x.ravel() for x in np.meshgrid(np.arange(1, 25, 0.1), np.arange(-0.5, 0.9, 0.01)))
    load = np.column_stack([v, v**3, v * a]) @ THETA[:3]
    seen = (load > 0) & (load < 250e3)
    full = gate().coverage(counts(v[seen], a[seen]), THETA[:3], load[seen])
    assert full.fraction > 0.95
    slow = seen & (v < 12)
    half = gate().coverage(counts(v[slow], a[slow]), THETA[:3], load[slow])
    assert half.available < full.available
    weak = gate().coverage(counts(v[slow], a[slow]), THETA[:3], np.full(10, 50e3))
    assert weak.available < half.available
    assert 0 <= weak.occupied <= weak.available


def test_a_cell_needs_enough_samples():
    v = np.repeat(np.arange(5.0, 20.0, 2.5), 9)
    power = np.full(len(v), 100e3)
    assert gate().coverage(counts(v, 0.05 + 0 * v), THETA[:3], power).occupied == 0
    assert gate(cell_count=9).coverage(counts(v, 0.05 + 0 * v), THETA[:3], power).occupied == 6


def test_wanted_cells_are_reachable_and_not_occupied():
    v, a = np.array([11.0] * 10 + [11.0] * 9 + [21.0] * 10), np.array([0.05] * 10 + [0.15] * 9 + [0.05] * 10)
    covered = gate().coverage(counts(v, a), THETA[:3], np.full(len(v), 250e3))
    assert len(covered.wanted) == covered.available - covered.occupied
    assert GRID.cell(np.array([11.0]), np.array([0.15]))[0] in covered.wanted  # begun only
    assert not set(GRID.cell(np.array([11.0, 21.0]), np.array([0.05, 0.05])).tolist()) & set(covered.wanted)
    speed, acceleration = GRID.centres()
    assert speed[list(covered.wanted)].max() < 22.5
    assert acceleration[list(covered.wanted)].max() < 0.2


def test_an_empty_window_covers_nothing():
    assert gate().coverage(np.zeros(GRID.size, dtype=np.int64), THETA[:3], np.empty(0)) == Coverage(0, 0)


# News


def test_news():
    assert not has_news(GateConfig(), 0, 0, 0)
    assert has_news(GateConfig(), 1, 0, 1)
    assert not has_news(GateConfig(new_samples=0.1), 1099, 1000, 1000)
    assert has_news(GateConfig(new_samples=0.1), 1100, 1000, 1000)
    assert not has_news(GateConfig(new_samples=0.0), 1000, 1000, 1000)


def test_power_that_is_negative_while_the_vehicle_accelerates_has_the_wrong_sign():
    pulling, power = np.full(9, 1.1 * MIN_PULLING_ACCELERATION), np.arange(9.0) + 1e3
    assert wrong_sign_of(power, pulling) == ""
    assert "sign of the torque" in wrong_sign_of(-power, pulling)
    assert wrong_sign_of(-power, 0.9 * pulling / 1.1) == ""  # gravity may accelerate it
    assert wrong_sign_of(np.where(np.arange(9) < 4, -power, power), pulling) == ""  # not most of it
    assert wrong_sign_of(power[:0], pulling[:0]) == ""


def test_power_that_is_too_small_for_any_vehicle_has_the_wrong_unit():
    acceleration = np.linspace(0.0, 1.5, 40)
    force = 2_800.0 * acceleration + 500.0
    assert wrong_unit_of(force, acceleration, 500.0) == ""
    assert wrong_unit_of(np.where(np.arange(40) < 30, 0.1, force), acceleration, 500.0) == ""  # mostly downhill
    assert "at most 7 kg: check its unit" in wrong_unit_of(force / 1e3, acceleration, 500.0)
    assert wrong_unit_of(force[:0], acceleration[:0], 500.0) == ""
