"""The estimator on rows: everything is accounted for, nothing waits for ever, and what fails says why."""

from dataclasses import replace

import numpy as np
import pytest
from made_estimates import made_estimate

from estimator.config import Config, from_dict
from estimator.estimates import Estimate, Status
from estimator.estimation.estimator import Estimator
from estimator.model.road_load import design
from estimator.model.road_load import power as model
from estimator.preparation import stage
from estimator.preparation.admission import Reason
from estimator.samples import STEP, Rows
from estimator.signals import Quantity, Role

THETA = np.array([1739.0, 3.74, 27_190.0])


def drive(n: int, seed: int = 1, first: int = 0) -> Rows:
    """Rows of a drive with stops; the brakes do what the engine's drag of 15 kW cannot."""
    rng = np.random.default_rng(seed)
    t = (first + np.arange(n)) * STEP
    v = np.maximum(
        13 + 9 * np.sin(2 * np.pi * t / 190) + 4 * np.sin(2 * np.pi * t / 47) + np.sin(2 * np.pi * t / 17), 0
    )
    P = design(v, np.gradient(v, STEP)) @ THETA
    brake = (P < -15e3).astype(float)
    P = np.maximum(P, -15e3) + rng.normal(0, 3e3, n)
    fresh = np.ones((n, 2), dtype=bool)
    return Rows(
        index=first + np.arange(n),
        speed=v + rng.normal(0, 0.01, n),
        power=P,
        fresh=fresh,
        context={Role.BRAKE_SWITCH: brake},
    )


ONCE = {"interval_s": 1e4}  # of the gate: only the conclusion at the end


def new(**tables) -> Estimator:
    config = from_dict(tables)
    return Estimator(config, np.random.default_rng(config.sampler.seed))


def run(estimator: Estimator, rows: Rows, piece: int = 50) -> list:
    updates = []
    for i in range(0, len(rows), piece):
        updates += estimator.feed(rows[i : i + piece])
    return [*updates, *estimator.finish()]


def known(estimator: Estimator) -> np.ndarray:
    """Times of the strides whose force is known [s]."""
    strides = estimator.window.strides
    return strides.t[strides.known]


def accounted(estimator: Estimator) -> int:
    early = {reason: count for reason, count in estimator.rejected.items() if reason != Reason.EVICTED}
    return estimator.window.added + sum(early.values())


def test_model_power_is_never_negative():
    assert model(np.array([20.0, 20.0]), np.array([0.1, -1.0]), THETA).tolist() == pytest.approx([119_080.0, 0.0])


@pytest.mark.slow
def test_truth_comes_back():
    estimate = run(new(gate=ONCE), drive(18_000))[-1]
    assert estimate.status == Status.ESTIMATED
    assert estimate.mass.mean == pytest.approx(THETA[2], rel=0.01)
    assert estimate.A.mean == pytest.approx(THETA[0], rel=0.06)
    assert estimate.C.mean == pytest.approx(THETA[1], rel=0.06)
    assert estimate.t == pytest.approx(1799.9)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 100, 121, 500, 2500, 6017])
def test_every_row_is_accounted_for_once(n):
    estimator = new()
    run(estimator, drive(6017)[:n])
    assert accounted(estimator) == n


@pytest.mark.slow
def test_rows_are_accounted_for_over_gaps_and_evictions():
    estimator = new(window={"samples": 1000})
    first, second, third = drive(4000), drive(30, first=4100), drive(4000, first=5000)
    for rows in (first, second, third):
        for i in range(0, len(rows), 50):
            list(estimator.feed(rows[i : i + 50]))
    list(estimator.finish())
    assert accounted(estimator) == 8030
    assert estimator.rejected[Reason.EVICTED] == estimator.window.added - len(estimator.window) > 0
    latest = estimator.latest
    assert latest.admitted == len(estimator.window)


@pytest.mark.slow
def test_rows_come_to_the_same_however_they_are_cut():
    """Updates may fall due at other blocks; what the window holds at the end has the same bits."""
    rows = drive(6000)
    estimators = [new(gate={"minimum_samples": 600}) for _ in range(3)]
    final = [run(each, rows, piece)[-1] for each, piece in zip(estimators, (50, 73, 6000), strict=True)]
    whole = estimators[-1].window.strides
    assert len(whole) > 300
    for each, estimate in zip(estimators[:-1], final[:-1], strict=True):
        strides = each.window.strides
        for column in ("t", "force", "a", "speed_squared", "known"):
            np.testing.assert_array_equal(getattr(strides, column), getattr(whole, column))
        assert each.rejected == estimators[-1].rejected
        assert estimate.admitted == final[-1].admitted
        assert estimate.mass.mean == pytest.approx(final[-1].mass.mean, abs=0.2 * estimate.mass.sd)


@pytest.mark.slow
def test_a_gap_is_not_bridged():
    estimator = new()
    list(estimator.feed(drive(3000)))
    updates = list(estimator.feed(drive(3000, first=4000)))
    assert updates[0].t == pytest.approx(299.9)
    list(estimator.finish())
    t = known(estimator)
    assert not np.any((t > 299) & (t < 400.5))


@pytest.mark.slow
def test_a_new_drive_forgets():
    estimator = new(gate=ONCE)
    run(estimator, drive(6000))
    assert estimator.latest.status == Status.ESTIMATED
    estimator.forget()
    assert estimator.latest is None
    assert len(estimator.window) == 0
    assert run(estimator, drive(100))[-1].status == Status.UNESTIMATED
    assert run(estimator, drive(6000, first=-100_000))[-1].status == Status.ESTIMATED


def test_each_drive_waits_for_the_signals_of_its_effects():
    """A heading that comes 15 s after the beginning."""

    def rows(first: int) -> Rows:
        whole = drive(3000, first=first)
        heading = np.where(np.arange(3000) < 150, np.nan, 1.0)
        return replace(whole, context={**whole.context, Role.HEADING: heading})

    stages = stage.StrideStage(from_dict({"effects": ["headwind"]}))
    wanted = []
    for first in (0, 50_000):
        whole = rows(first)
        for i in range(0, 3000, 50):
            list(stages.feed(whole[i : i + 50]))
        wanted.append(stages.wanted)
        list(stages.finish())
        stages.forget()
    assert wanted == [frozenset({Quantity.HEADING})] * 2


@pytest.mark.slow
def test_updates_come_at_the_interval_and_only_with_news():
    moving = drive(6000)
    standing = Rows(
        index=6000 + np.arange(6000),
        speed=np.zeros(6000),
        power=np.zeros(6000),
        fresh=np.ones((6000, 2), dtype=bool),
        context={},
    )
    estimator = new(gate={"interval_s": 30})
    updates = []
    for rows in (moving, standing):
        for i in range(0, 6000, 50):
            updates += estimator.feed(rows[i : i + 50])
    times = np.array([update.t for update in updates])
    assert np.all(np.diff(times[times < 600]) > 19)
    assert len(times[times < 600]) >= 12
    assert not np.any(times > 660)


@pytest.mark.parametrize("block", [100, 200, 1000])
@pytest.mark.parametrize("piece", [7, 50, 400])
def test_the_load_is_the_same_until_a_stop_is_long_whatever_the_blocks(block, piece, monkeypatch):
    monkeypatch.setattr(stage, "BLOCK_ROWS", block)
    speed = np.concatenate([np.full(300, 9.0), np.zeros(3200), np.full(150, 9.0)])
    rows = replace(
        drive(len(speed)), speed=speed, power=np.zeros(len(speed)), context={Role.BRAKE_SWITCH: np.zeros(len(speed))}
    )
    estimator = new()
    estimator._latest = made_estimate()
    for i in range(0, len(rows), piece):
        list(estimator.feed(rows[i : i + piece]))
        now = estimator._next * STEP
        assert (estimator.latest is not None and now < estimator.load_until) == (now < 30 + 300)


@pytest.mark.parametrize(("last", "until"), [(9.0, 300.0), (0.0, 299.9), (np.nan, 299.9)])
def test_without_rows_the_load_is_the_same_for_as_long_as_in_a_stop(last, until):
    estimator, rows = new(), drive(100)
    list(estimator.feed(replace(rows, speed=np.append(np.full(99, 9.0), last))))
    assert estimator.load_until - estimator._next * STEP == pytest.approx(until)


@pytest.mark.slow
def test_hours_of_standing_are_bounded():
    estimator = new()
    for i in range(150):
        n = 1000
        rows = Rows(
            index=i * n + np.arange(n),
            speed=np.zeros(n),
            power=np.zeros(n),
            fresh=np.ones((n, 2), dtype=bool),
            context={},
        )
        assert list(estimator.feed(rows)) == []
        assert len(estimator._stage._pending) <= stage.BLOCK_ROWS
        assert len(estimator._stage._strider.waiting_rows) <= 2 * stage.BLOCK_ROWS
    assert estimator.rejected[Reason.STANDING] > 100_000
    updates = []
    for i in range(0, 9000, 50):
        updates += estimator.feed(drive(9000, first=150_000)[i : i + 50])
    assert updates[-1].status == Status.ESTIMATED


def test_a_wide_margin_is_kept_over_blocks():
    rows = drive(6000)
    rows.context[Role.BRAKE_SWITCH][:] = 0
    rows.context[Role.BRAKE_SWITCH][3000] = 1
    estimator = new(admission={"stride_margin_s": 25.0}, gate=ONCE)
    run(estimator, rows)
    t = known(estimator)
    assert not np.any((t > 275.01) & (t < 324.99))
    assert np.any((t > 270) & (t < 275))
    assert np.any((t > 325) & (t < 330))
    assert accounted(estimator) == 6000


@pytest.fixture(scope="module")
def clean() -> Estimate:
    return run(new(gate=ONCE), drive(9000))[-1]


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 8.0, 60.0])
def test_a_glitch_of_the_speed_does_no_harm(clean, value):
    rows = drive(9000)
    rows.speed[4000:4002] = value
    estimator = new(gate=ONCE)
    estimate = run(estimator, rows)[-1]
    assert estimate.status == Status.ESTIMATED
    assert estimate.mass.mean == pytest.approx(clean.mass.mean, abs=clean.mass.sd)
    assert estimate.mass.sd < 1.1 * clean.mass.sd
    assert estimator.rejected[Reason.SPEED_IMPLAUSIBLE] == 4
    assert accounted(estimator) == 9000


# Why there is no estimate


@pytest.mark.slow
def test_constant_speed_is_refused():
    rng = np.random.default_rng(1)
    n = 9000
    v = 22 + rng.normal(0, 0.01, n)
    P = model(np.full(n, 22.0), np.zeros(n), THETA) + rng.normal(0, 3e3, n)
    updates = run(new(), Rows(index=np.arange(n), speed=v, power=P, fresh=np.ones((n, 2), dtype=bool), context={}))
    assert {update.status for update in updates} == {Status.UNESTIMATED}
    assert updates[-1].reason
    assert updates[-1].mass is None


def test_the_reason_names_what_most_rows_suffer_from():
    n = 3000
    rows = Rows(index=np.arange(n), speed=np.zeros(n), power=np.zeros(n), fresh=np.ones((n, 2), dtype=bool), context={})
    reason = run(new(), rows)[-1].reason
    assert reason.startswith("0 usable samples")
    assert reason.endswith("most others: standing")


def test_a_prior_that_the_data_contradict_is_named():
    estimate = run(new(gate=ONCE, prior={"mass_kg": [1000, 5000]}), drive(9000))[-1]
    assert estimate.status != Status.ESTIMATED
    assert estimate.reason.startswith("mass ")


def test_nothing_at_all():
    estimator = Estimator(Config(), np.random.default_rng(1))
    assert list(estimator.finish()) == []
    assert estimator.latest is None
    assert not estimator.rejected


def test_unknown_readings_are_survived():
    rows = drive(3000)
    rows.speed[:], rows.power[:] = np.nan, np.nan
    estimate = run(new(), rows)[-1]
    assert estimate.status == Status.UNESTIMATED
    assert estimate.admitted == 0
