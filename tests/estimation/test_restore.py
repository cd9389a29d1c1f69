"""A run that was interrupted goes on as if it had met a gap; what does not fit is refused whole."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.time_order import MAX_DELAY
from estimator.checkpoint.store import pack, unpack
from estimator.config import from_dict
from estimator.errors import StateError
from estimator.estimates import Status
from estimator.estimation.continued import Continued
from estimator.estimation.estimator import Estimator
from estimator.estimation.paper_inference import PaperInference
from estimator.estimation.road_inference import RoadInference
from estimator.model.road_load import design
from estimator.preparation.stage import StrideStage
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_counts import RowCounts
from estimator.streaming.row_stream import MIN_NEW_DRIVE_SILENCE, RowStream
from estimator.strides import DURATION

pytestmark = pytest.mark.slow

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
SAVED, END = 720.0, 1080.0  # s into the drive
SPARSE = {"gate": {"interval_s": 240.0}}
REBUILT = {  # what traffic or the configuration shows again
    Estimator: {"_config", "_interval", "_resting", "failed_updates", "segment"},
    StrideStage: {"_config", "_effects", "wanted"},
    RoadInference: {"_config", "_effects", "_gate", "_given", "_rng", "_window", "evidence"},
    Continued: {"_past"},
    PaperInference: {"_config", "_gate", "_rng", "_window", "evidence"},
    Pipeline: {"config", "_is_live", "_is_restored"},
    RowStream: {
        "_config",
        "_map",
        "_messages",
        "_names",
        "_waiting",
        "_last",
        "_block_end",
        "_first",
        "_answers",
        "_lines",
        "_is_restored",
        "_same_clock",
        "_now",
        "newest",
        "order",
        "references",
        "rows",
        "start",
    },
    RowCounts: {"until", "switches", "unusable"},
}


def new(**tables) -> Pipeline:
    return Pipeline(from_dict(SPARSE | tables))


def stored(state) -> dict:
    """As it comes back from the disk."""
    return unpack(pack(state, "k"), "k")


@pytest.fixture(scope="module")
def drive() -> Frames:
    rng = np.random.default_rng(1)
    return frames_of(record(TRUCK, generate_route("mixed", 3e4, rng), END, rng).signals)


def between(frames: Frames, low: float, high: float) -> Frames:
    return frames[(frames.t >= EPOCH + low) & (frames.t < EPOCH + high)]


def moved(frames: Frames, by: float) -> Frames:
    return replace(frames, t=frames.t + by)


@pytest.fixture(scope="module")
def state(drive) -> dict:
    pipeline = new()
    list(pipeline.feed(between(drive, 0, SAVED)))
    assert pipeline.estimator.latest.status == Status.ESTIMATED
    return stored(pipeline.state())


def restored(state, **tables) -> Pipeline:
    pipeline = new(**tables)
    pipeline.restore(state)
    return pipeline


def run(pipeline: Pipeline, frames: Frames):
    return [*pipeline.feed(frames), *pipeline.finish()][-1]


# The estimator, to the bit


def rows_of(n: int, first: int = 0) -> Rows:
    rng = np.random.default_rng(1)
    t = (first + np.arange(n + 2)) * STEP
    v = np.maximum(
        13 + 9 * np.sin(2 * np.pi * t / 190) + 4 * np.sin(2 * np.pi * t / 47) + np.sin(2 * np.pi * t / 17), 0
    )
    P = design(v, np.gradient(v, STEP)) @ np.array([1739.0, 3.74, 27_190.0])
    brake = (P < -15e3).astype(float)
    P = np.maximum(P, -15e3) + rng.normal(0, 3e3, n + 2)
    fresh = np.ones((n + 2, 2), dtype=bool)
    index = first + np.arange(n + 2)
    return Rows(
        index=index, speed=v + rng.normal(0, 0.01, n + 2), power=P, fresh=fresh, context={Role.BRAKE_SWITCH: brake}
    )[:n]


@pytest.mark.parametrize(
    ("n", "likelihood"),
    [(n, "road") for n in (0, 50, 4000)] + [(4000, "paper")],
)
def test_an_estimator_goes_on_to_the_bit(n, likelihood):
    """Also when nothing has come yet."""
    config = from_dict({"sampler": {"likelihood": likelihood}, "gate": {"interval_s": 180.0}})

    def made() -> Estimator:
        return Estimator(config, np.random.default_rng(1))

    before, after = rows_of(n), rows_of(4000, first=n + 100)
    whole, first, second = made(), made(), made()
    for i in range(0, n, 50):
        list(whole.feed(before[i : i + 50]))
        list(first.feed(before[i : i + 50]))
    second.restore(stored(first.state()))
    assert second.latest is None
    assert list(second.resume(same_load=True)) == list(whole.finish())
    for i in range(0, 4000, 50):
        assert list(second.feed(after[i : i + 50])) == list(whole.feed(after[i : i + 50]))
    assert list(second.finish()) == list(whole.finish())
    assert second.latest.status == Status.ESTIMATED
    assert second.rejected == whole.rejected
    assert second.window.strides.t.tolist() == whole.window.strides.t.tolist()


# The pipeline


@pytest.fixture(scope="module")
def uninterrupted(drive) -> Pipeline:
    pipeline = new()
    run(pipeline, drive)
    return pipeline


@pytest.mark.parametrize("away", [0.0, 20.0])
def test_a_short_absence_changes_next_to_nothing(drive, state, uninterrupted, away):
    pipeline = restored(state)
    estimate, expected = run(pipeline, between(drive, SAVED + away, END)), uninterrupted.estimator.latest
    assert estimate.status == Status.ESTIMATED
    for name in ("mass", "A", "C"):
        one, other = getattr(estimate, name), getattr(expected, name)
        assert one.mean == pytest.approx(other.mean, abs=0.5 * other.sd)
        assert one.sd == pytest.approx(other.sd, rel=0.2)
    # Lost: the absence, and what had not become rows: at most BLOCK + SETTLE + MAX_DELAY before and a moment after it.
    assert 0 <= (uninterrupted.traffic.rows.valid - pipeline.traffic.rows.valid) * STEP - away < 12
    assert any(a == pytest.approx(EPOCH + SAVED, abs=1 + MAX_DELAY) for a, b in pipeline.traffic.rows.gaps)
    missed = between(drive, SAVED, SAVED + away)
    assert pipeline.traffic.frames + len(missed) == uninterrupted.traffic.frames


@pytest.mark.parametrize("away", [0.0, 0.5, 20.0, 60.0])
def test_rows_are_never_joined_over_the_absence(drive, state, away):
    pipeline = restored(state)
    run(pipeline, between(drive, SAVED + away, SAVED + away + 200))
    strides = pipeline.estimator.window.strides
    t = strides.t[strides.known] - EPOCH
    assert np.any(t < SAVED)
    assert np.any(t > SAVED + away)
    assert not np.any((t > SAVED - DURATION / 2) & (t < SAVED + away + DURATION / 2))
    after = np.searchsorted(strides.t - EPOCH, SAVED)
    assert not strides.joined[after]
    assert strides.s0[after] - strides.s1[after - 1] > 10_000.0  # no road connects them


@pytest.mark.parametrize(
    "away", [MIN_NEW_DRIVE_SILENCE + 60, -3600.0, -EPOCH], ids=["long", "clock set back", "clock never set again"]
)
def test_after_a_long_absence_the_load_is_another(drive, state, away):
    pipeline = restored(state)
    list(pipeline.feed(moved(between(drive, SAVED, SAVED + 60), away)))
    assert len(pipeline.estimator.window) == 0 or pipeline.estimator.window.strides.t[0] > EPOCH + SAVED + away
    assert pipeline.estimator.latest is None
    estimate = run(pipeline, moved(between(drive, SAVED + 60, END), away))
    assert estimate.status == Status.ESTIMATED
    assert estimate.load.before == pytest.approx(TRUCK.mass, rel=0.02)
    assert estimate.load.probability < 0.5


def test_a_clock_that_starts_anew_with_the_power_tells_no_absence(drive):
    pipeline = new()
    list(pipeline.feed(moved(between(drive, 0, SAVED), -EPOCH)))
    pipeline = restored(stored(pipeline.state()))
    list(pipeline.feed(moved(between(drive, SAVED + 10, SAVED + 20), -EPOCH)))
    assert len(pipeline.estimator.window) == 0


def test_no_clock_tells_for_how_long_the_machine_was_off(drive, state):
    """It may have gone on from where it stood when the power went."""
    pipeline = new()
    pipeline.restore(state, same_clock=False)
    list(pipeline.feed(between(drive, SAVED + 10, SAVED + 20)))
    assert len(pipeline.estimator.window) == 0
    assert pipeline.estimator.latest is None
    estimate = run(pipeline, between(drive, SAVED + 20, END))
    assert estimate.load.before == pytest.approx(TRUCK.mass, rel=0.02)


@pytest.mark.parametrize(("away", "is_same"), [(20.0, True), (299.0, False), (7200.0, False)])
def test_a_clock_that_is_set_back_in_the_absence_hides_none_of_it(drive, away, is_same):
    """By message times it is 20 s, as long as before the rows that the state lacks."""
    pipeline = new()
    list(pipeline.feed(between(drive, 0, SAVED), 1000.0))
    pipeline = restored(stored(pipeline.state()))
    before, held = pipeline.estimator.segment, len(pipeline.estimator.window)
    list(pipeline.feed(between(drive, SAVED + 20, SAVED + 20.5), 1000.0 + away - 1))
    list(pipeline.feed(between(drive, SAVED + 20.5, SAVED + 80), 1000.0 + away))
    assert (pipeline.estimator.segment == before) == is_same
    assert (len(pipeline.estimator.window) > held) == is_same
    assert (pipeline.estimator.latest is not None) == is_same


def test_nothing_is_claimed_before_the_absence_is_known(state):
    pipeline = restored(state)
    assert pipeline.estimator.latest is None
    assert list(pipeline.finish()) == []
    assert pipeline.estimator.latest is None


def test_columns_of_effects_come_back(drive):
    pipeline = new(effects=["warm_up"])
    list(pipeline.feed(between(drive, 0, SAVED)))
    state = stored(pipeline.state())
    again = restored(state, effects=["warm_up"])
    list(again.feed(between(drive, SAVED + 20, SAVED + 120)))
    assert len(again.estimator.window) > len(pipeline.estimator.window)
    assert again.estimator.window.strides.context.keys() == pipeline.estimator.window.strides.context.keys() != set()
    with pytest.raises(StateError, match="other columns"):
        restored(spoilt(state, ("estimator", "stage", "strider", "wanted"), "cut"), effects=["warm_up"])


def test_the_engine_is_remembered(drive, state):
    """Reference torque comes every five seconds; rows before it would have no power."""
    part = between(drive, SAVED + 60, SAVED + 200)
    without = part[((part.ident >> 16) & 0xFF) != 0xEC]
    pipeline = restored(state)
    before = pipeline.traffic.rows.valid
    run(pipeline, without)
    assert pipeline.traffic.rows.valid - before > 1300


def test_the_engine_is_remembered_over_a_silence_and_forgotten_when_time_steps_back(drive):
    pipeline = new()
    list(pipeline.feed(between(drive, 0, 100)))
    learnt = pipeline.state()["aligner"]["engine"]
    assert learnt["reference"] is not None
    list(pipeline.feed(between(drive, 200, 203)))
    after = pipeline.state()["aligner"]["engine"]
    assert after["reference"] == learnt["reference"]
    assert after["friction"]["sums"][0].sum() > 0.9 * learnt["friction"]["sums"][0].sum() > 0
    list(pipeline.feed(between(drive, 50, 53)))
    assert pipeline.state()["aligner"]["engine"]["reference"] is None
    assert pipeline.state()["aligner"]["engine"]["friction"]["sums"].sum() == 0


def test_a_sender_that_was_exchanged_is_found_on_the_next_drive(drive, state):
    def by(frames: Frames, source: int) -> Frames:
        return replace(frames, ident=(frames.ident & np.uint32(0xFFFFFF00)) | np.uint32(source))

    assert {choice["source"] for choice in state["decoder"]["choices"].values()} != {0x77}
    same = restored(state)
    list(same.feed(by(between(drive, SAVED, SAVED + 8), 0x77)))
    assert same.traffic.sources["EEC1.EngSpeed"] != 0x77
    later = restored(state)
    list(later.feed(moved(by(between(drive, SAVED, SAVED + 30), 0x77), 2 * MIN_NEW_DRIVE_SILENCE)))
    assert set(later.traffic.sources.values()) == {0x77}


def test_other_limits_of_the_gate_judge_what_was_kept(drive, state):
    rest = between(drive, SAVED, END)
    expected = run(restored(state), rest)
    limits = {"minimum_samples": 1000, "minimum_cells": 9, "coverage": 0.2, "relative_sd": (0.4, 0.4, 0.09)}
    assert run(restored(state, gate=SPARSE["gate"] | limits), rest) == expected
    refused = run(restored(state, gate=SPARSE["gate"] | {"relative_sd": (0.5, 0.5, 1e-6)}), rest)
    assert refused.status == Status.UNESTIMATED
    assert refused.admitted == expected.admitted


def test_another_interval_holds_from_the_restore_on(drive, state):
    kept, rest = deepcopy(state), between(drive, SAVED, END)
    kept["estimator"]["due"] += round(3600.0 / STEP)  # as an interval of an hour leaves it
    expected, pipeline = run(restored(state), rest), restored(kept, gate={"interval_s": 60.0})
    _, *updates = pipeline.feed(rest)  # the first is of the rows before the absence
    times = np.array([update.t for update in updates]) - EPOCH
    assert len(times) > 3
    assert np.all(np.diff(times) >= 59.0)
    assert times[0] < SAVED + 120.0  # the second minute has news
    *_, estimate = pipeline.finish()
    assert estimate.admitted == expected.admitted
    assert estimate.mass.mean == pytest.approx(expected.mass.mean, abs=0.5 * expected.mass.sd)


def test_restored_and_saved_again_is_the_same(state):
    assert pack(restored(state).state(), "k") == pack(state, "k")


@pytest.mark.parametrize("designed", [True, False])
def test_the_design_of_the_road_comes_back(state, designed):
    kept = deepcopy(state)
    kept["estimator"]["inference"]["scales"]["designed"] = designed
    assert restored(kept).state()["estimator"]["inference"]["scales"]["designed"] is designed


def test_the_turns_of_the_road_come_back(state):
    kept = deepcopy(state)
    turns = np.array([[1200.0, 1350.0], [4000.0, 4100.0]])
    kept["estimator"]["inference"]["scales"]["turns"] = turns
    assert_array_equal(restored(kept).state()["estimator"]["inference"]["scales"]["turns"], turns)


def test_the_orders_that_lost_come_back_and_those_of_other_signals_are_refused(state):
    kept = deepcopy(state)
    inference = kept["estimator"]["inference"]
    assert inference["lost"]
    back = restored(kept).state()["estimator"]["inference"]["lost"]
    assert [scales["alpha"] for scales in back] == [scales["alpha"] for scales in inference["lost"]]
    inference["lost"][0]["readings"] = [*inference["scales"]["readings"], "gravity"]
    inference["lost"][0]["values"] = np.ones(len(inference["scales"]["values"]) + 3)
    with pytest.raises(StateError, match="lost: scales of other signals"):
        restored(kept)


@pytest.mark.parametrize(
    "kind", [Estimator, StrideStage, RoadInference, Continued, PaperInference, Pipeline, RowStream, RowCounts]
)
def test_whatever_a_run_keeps_is_saved_or_known_to_come_again(state, kind):
    """A new attribute belongs into the state, or into REBUILT."""
    is_paper = kind is PaperInference
    pipeline = new(sampler={"likelihood": "paper"}) if is_paper else new()
    if is_paper:
        state = pipeline.state()
    one, saved = {
        Estimator: (pipeline.estimator, state["estimator"]),
        StrideStage: (pipeline.estimator._stage, state["estimator"]["stage"]),
        RoadInference: (pipeline.estimator._inference, state["estimator"]["inference"]),
        Continued: (Continued(), Continued().state()),
        PaperInference: (pipeline.estimator._inference, state["estimator"]["inference"]),
        Pipeline: (pipeline, {"traffic": None, **state}),
        RowStream: (pipeline.traffic, state),
        RowCounts: (pipeline.traffic.rows, {"valid": state["valid_rows"], "gaps": state["gaps"]}),
    }[kind]
    known = {f"_{name}" for name in saved} | set(saved) | REBUILT[kind]
    assert set(vars(one)) <= known


# What does not fit


def leaves(value, path=()):
    """Where everything in a state stands, at any depth."""
    if path:
        yield path
    if isinstance(value, dict):
        for key in value:
            yield from leaves(value[key], (*path, key))


def spoilt(state, path, how):
    """A copy of ``state`` with one thing in it changed."""
    *way, last = path
    state = place = dict(state)
    for key in way:
        place[key] = dict(place[key])
        place = place[key]
    value = place[last]
    if how == "gone":
        del place[last]
    elif how == "other type":
        place[last] = "x" if not isinstance(value, str) else 3
    elif how == "none":
        place[last] = None
    elif how == "negative":
        numeric = isinstance(value, int | float) or (isinstance(value, np.ndarray) and value.dtype != bool)
        place[last] = -abs(value) - 1 if numeric else -1
    elif how == "not finite":
        place[last] = np.full_like(value, np.nan) if getattr(value, "dtype", None) == np.float64 else float("nan")
    elif how == "cut":
        place[last] = value[:-1] if isinstance(value, np.ndarray | list | str) else {}
    return state


HOWS = ["gone", "other type", "none", "negative", "not finite", "cut"]


@pytest.mark.parametrize(
    "how", [how if how == "negative" else pytest.param(how, marks=pytest.mark.nightly) for how in HOWS]
)
def test_a_spoilt_state_is_refused_whole_or_harmless(state, drive_end, how):
    pipeline = new()
    untouched, refused = pack(pipeline.state(), "k"), 0
    for number, path in enumerate(leaves(state)):
        try:
            pipeline.restore(spoilt(state, path, how))
        except StateError:
            refused += 1
            assert pack(pipeline.state(), "k") == untouched
            continue
        # An update takes a second: each way of spoiling looks at another fifth of what was taken up.
        for estimate in pipeline.feed(drive_end) if number % 5 == HOWS.index(how) % 5 else ():
            if estimate.status == Status.ESTIMATED:
                assert estimate.mass.mean == pytest.approx(TRUCK.mass, rel=0.1)
        pipeline = new()
    assert refused > 20


@pytest.fixture(scope="module")
def drive_end(drive) -> Frames:
    return between(drive, SAVED + 30, SAVED + 45)


@pytest.mark.parametrize(
    ("path", "how"),
    [
        (("estimator", "window", "strides", "v0"), "not finite"),
        (("estimator", "window", "strides", "force"), "cut"),
        (("estimator", "window", "lengths"), "negative"),
        (("estimator", "inference", "loads", "shown", "covariance"), "negative"),
        (("estimator", "inference", "scales", "values"), "negative"),
        (("estimator", "inference", "scales", "point"), "other type"),
        (("estimator", "stage", "strider", "distance"), "not finite"),
        (("estimator", "inference", "generator"), "cut"),
        (("estimator", "stage", "rejected"), "other type"),
        (("aligner", "engine", "friction", "sums"), "negative"),
        (("decoder", "contested"), "none"),
        (("until",), "gone"),
    ],
)
def test_the_worst_spoils_are_refused(state, path, how):
    with pytest.raises(StateError, match=r"^[^\n]+$"):
        restored(spoilt(state, path, how))


def test_a_state_of_another_configuration_is_refused(state):
    with pytest.raises(StateError, match=r"window: \d+ rows"):
        restored(state, window={"samples": 600})
    with pytest.raises(StateError, match="choices: of other signals than are bound"):
        restored(state, signals={"speed": "CCVS1.WheelBasedVehicleSpeed"})
