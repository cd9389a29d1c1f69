"""Load segments: a long stop starts the mass afresh, the vehicle is remembered, a change is noticed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import from_dict, replace
from estimator.estimates import Estimate
from estimator.estimation.load_segments import Loads, Segment, load_change
from estimator.preparation.standstill import Standstill
from estimator.settings import Load, Prior
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

SPARSE = from_dict({"gate": {"interval_s": 240.0}})


@pytest.mark.slow
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 80)), max_size=20), st.randoms(use_true_random=False))
def test_departures_are_found_however_the_rows_are_cut(runs, random):
    speed = np.concatenate([[10.0], *(np.full(n, 10.0 * moving) for moving, n in runs), [10.0]])
    standing = "".join("s" if v < 1 else "m" for v in speed)
    expected = sum(len(stop) >= 50 for stop in standing.split("m"))
    watch = Standstill(Load(stop_s=5.0), 1.0)
    found, at = 0, 0
    while at < len(speed):
        size = random.randint(1, 30)
        found += len(watch.departures(speed[at : at + size]))
        at += size
    assert found == expected


def test_unknown_speed_ends_no_stop():
    watch = Standstill(Load(stop_s=5.0), 1.0)
    assert watch.departures(np.full(30, 0.0)) == []
    assert watch.departures(np.full(30, np.nan)) == []
    assert watch.departures(np.array([0.0, 3.0])) == [1]


def test_a_silence_counts_as_standing():
    watch = Standstill(Load(stop_s=5.0), 1.0)
    assert watch.departures(np.full(10, 9.0)) == []
    watch.pause(60)
    assert watch.departures(np.full(10, 9.0)) == [0]


def segment(m: float, sd: float) -> Segment:
    return Segment(np.array([0.06 * m, 3.7, m]), np.diag([20.0, 0.05, sd]) ** 2, 0.0)


def test_probability_of_another_load():
    assert load_change(segment(15_000, 150), segment(32_000, 150)).probability > 0.999
    assert load_change(segment(15_000, 150), segment(15_100, 150)).probability < 0.05
    vague = load_change(segment(15_000, 5000), segment(18_000, 5000)).probability
    assert 0.1 < vague < 0.9


def test_what_is_carried_over_is_rolling_coefficient_and_drag():
    belief = segment(15_000, 50).carry_over(0.0, Load(change_sd=0.1, drift_per_hour=0.0))

    def distance(A: float, C: float, m: float) -> float:
        theta = np.array([A, C, m])
        return float(theta @ belief.precision @ theta - 2 * theta @ belief.moment)

    best = distance(900, 3.7, 15_000)
    assert distance(1800, 3.7, 30_000) == pytest.approx(best, abs=1e-6)  # twice the load rolls twice as hard
    assert distance(1800, 3.7, 15_000) > best + 50
    assert distance(900, 4.6, 15_000) > best + 4
    later = segment(15_000, 50).carry_over(100 * 3600.0, Load())
    assert np.all(np.diag(later.precision)[:3] < np.diag(belief.precision)[:3])


def test_driving_that_stays_in_use_is_not_carried_over_as_well():
    loads = Loads()
    loads.show(segment(15_000, 150))
    loads.start_segment(kept=True)
    assert not loads.carried_over(0.0, Load()).precision.any()
    change = loads.show(segment(15_000, 150))
    assert change is not None
    assert change.before == 15_000
    loads.start_segment()
    assert loads.carried_over(0.0, Load()).precision.any()


@pytest.fixture(scope="module")
def shift() -> list[list[Estimate]]:
    """One pipeline through three drives: half empty, full, full; ten minutes of standing in between."""
    rng = np.random.default_rng(6)
    pipeline = Pipeline(SPARSE)
    updates, start = [], 0.0
    for mass, A in ((15_000.0, 1000.0), (32_000.0, 2100.0), (32_000.0, 2100.0)):
        route = generate_route("mixed", 50e3, rng)
        frames = frames_of(record(Truck(mass=mass, A=A, C=3.7), route, 960.0, rng).signals)
        updates.append(list(pipeline.feed(Frames(frames.t + start, frames.ident, frames.length, frames.data))))
        start += 960.0 + 600.0
    updates[-1] += pipeline.finish()
    return updates


@pytest.mark.slow
def test_mass_follows_the_load(shift):
    for updates, mass in zip(shift, (15_000, 32_000, 32_000), strict=True):
        last = updates[-1]
        assert last.status == "estimated"
        assert last.mass is not None
        assert last.mass.mean == pytest.approx(mass, rel=0.02)
    # Nothing of the old load is claimed for the new one.
    assert shift[1][1].mass is None


@pytest.mark.slow
def test_a_change_of_load_is_noticed_and_its_absence_too(shift):
    changed, same = shift[1][-1].load, shift[2][-1].load
    assert changed is not None
    assert same is not None
    assert changed.probability > 0.99
    assert (changed.before, changed.after) == (pytest.approx(15_000, rel=0.02), pytest.approx(32_000, rel=0.02))
    assert same.probability < 0.2


@pytest.mark.slow
def test_a_weigh_ticket_is_believed():
    rng = np.random.default_rng(8)
    truck = Truck(mass=25_000.0, A=1500.0, C=3.5)
    frames = frames_of(record(truck, generate_route("mixed", 30e3, rng), 900.0, rng).signals)
    plain, told = (
        [*p.feed(frames), *p.finish()][-1]
        for p in (Pipeline(SPARSE), Pipeline(replace(SPARSE, prior=Prior(mass_belief_kg=(25_000.0, 50.0)))))
    )
    assert plain.mass is not None
    assert told.mass is not None
    assert told.mass.sd < 50 < plain.mass.sd
    assert told.mass.mean == pytest.approx(25_000, abs=150)
