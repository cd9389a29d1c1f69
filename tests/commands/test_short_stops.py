"""A bus whose load changes at every stop: a mass from stop to stop, with an interval that holds it."""

import numpy as np
import pytest

from estimator.checkpoint.store import pack, unpack
from estimator.config import from_dict
from estimator.errors import StateError
from estimator.streaming.pipeline import Pipeline

pytestmark = pytest.mark.slow

STOPS = 12


@pytest.fixture(scope="module")
def tool():
    import check_short_stops

    return check_short_stops


@pytest.fixture(scope="module")
def bus(tool):
    return tool.line(STOPS, 0.0, np.random.default_rng(2))


def test_every_way_has_a_mass_of_its_own(tool, bus):
    frames, ways = bus
    truth = np.array([way.mass for way in ways])
    found = tool.masses(frames, ways, from_dict(tool.SHORT_STOPS))
    known = [i for i, mass in enumerate(found) if mass is not None]
    assert len(known) >= STOPS - 4
    errors = np.array([found[i].mean / truth[i] - 1 for i in known])
    assert truth.std() > 0.05 * truth.mean()  # one mass for all ways would not do
    assert np.sqrt(np.mean(errors**2)) < 0.025
    assert sum(found[i].q05 <= truth[i] <= found[i].q95 for i in known) >= 0.8 * len(known)


def test_each_way_ends_with_an_estimate_of_its_own_mass_however_seldom_updates_are(tool, bus):
    frames, ways = bus
    pipeline = Pipeline(from_dict({**tool.SHORT_STOPS, "gate": {"interval_s": 1e9}}))
    updates = [*pipeline.feed(frames), *pipeline.finish()]
    assert len(updates) == STOPS
    departures = [way.start for way in ways[1:]]
    assert [update.t for update in updates[:-1]] == pytest.approx(departures, rel=0, abs=5.0)
    held = [u.mass.q05 <= way.mass <= u.mass.q95 for way, u in zip(ways, updates, strict=True) if u.mass is not None]
    assert len(held) >= STOPS - 4
    assert sum(held) >= 0.8 * len(held)


def test_without_the_option_the_load_counts_as_one(tool, bus):
    frames, ways = bus
    found = tool.masses(frames, ways, from_dict({"gate": tool.SHORT_STOPS["gate"]}))
    errors = np.array([mass.mean / way.mass - 1 for mass, way in zip(found, ways, strict=True) if mass is not None])
    assert np.sqrt(np.mean(errors**2)) > 0.025


def test_a_line_goes_on_after_a_power_loss(tool, bus):
    frames, ways = bus
    config = from_dict(tool.SHORT_STOPS)
    cut = ways[8].start + 20.0
    first, second = frames[frames.t < cut], frames[frames.t >= cut]
    before = Pipeline(config)
    list(before.feed(first))
    state = unpack(pack(before.state(), "k"), "k")
    after = Pipeline(config)
    after.restore(state)
    later = [update for update in (*after.feed(second), *after.finish()) if update.mass is not None]
    last, mass = later[-1].mass, ways[-1].mass
    assert last is not None
    assert last.q05 <= mass <= last.q95
    assert last.sd < 0.05 * mass
    state["estimator"]["inference"]["departures"] = [10.0, 5.0]
    with pytest.raises(StateError, match="departures"):
        Pipeline(config).restore(state)
