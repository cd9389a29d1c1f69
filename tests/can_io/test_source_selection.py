"""Which sender a signal is taken from, and when none is believed: decided by what is sent, and open to revision."""

from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truck_frames import LARGE, SPEED, TORQUE, TRUCK, announced, broadcast, cut, pack

from estimator.can_io.binding import bind, load_database
from estimator.can_io.contest import Contest
from estimator.can_io.contradiction import are_alternating, is_disagreement
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.can_io.own_rate import fastest
from estimator.config import from_dict
from estimator.errors import StateError
from estimator.signals import Role
from estimator.streaming.row_stream import Block, Interruption, RowStream

BLOCK = 5.0  # s
KMH = 256  # raw per km/h
SWITCH = {"signals": {"brake_switch": "BROADCAST.Switch"}}

Row = tuple[float, int, bytes]


class Judged:
    """A decoder fed block by block; what it passed on and what it contested."""

    def __init__(self, **tables) -> None:
        config = from_dict(tables)
        self.decoder = Decoder(bind(config, TRUCK), config.bus)
        self.values: list[list[float]] = []  # of the only role, by block
        self.contested: list[dict[str, str]] = []
        self.replaced: list[bool] = []
        self._end = 0.0

    def feed(self, *rows: Row, blocks: int = 1) -> "Judged":
        """``rows`` of one or several blocks."""
        frames = pack(*sorted(rows, key=lambda row: row[0])) if rows else Frames.concatenate([])
        for _ in range(blocks):
            start, self._end = self._end, self._end + BLOCK
            part = frames[(frames.t >= start) & (frames.t < self._end)]
            found = self.decoder.decode(part, self._end)
            series = next(iter(found.values()), [])
            self.values.append([float(v) for one in series for v in one.value])
            self.contested.append(dict(self.decoder.contested))
            self.replaced.append(self.decoder.replaced)
        return self

    def known(self, block: int) -> list[float]:
        """Valid values of a block."""
        return [v for v in self.values[block] if np.isfinite(v)]


def sender(source: int, blocks: range, factor: float = 1.0, rate: float = 10.0, phase: float = 0.0) -> list[Row]:
    """A speed of 60 km/h that swings by 10 in 20 s, from one address during some blocks."""
    t = np.arange(blocks.start * BLOCK + phase, blocks.stop * BLOCK, 1 / rate)
    speed = factor * (60 + 10 * np.sin(2 * np.pi * t / 20))
    return [broadcast(float(at), source, round(v * KMH)) for at, v in zip(t, speed, strict=True)]


def torque(source: int, *times: float, value: int = 2500) -> list[Row]:
    payload = bytes(19) + value.to_bytes(2, "little") + bytes(18)
    return [row for t in times for row in announced(t, source, LARGE, payload)]


# The first sender, and one that falls silent


def test_of_several_first_senders_the_one_with_most_values_is_taken():
    judged = Judged(**SPEED).feed(broadcast(0.0, 7, 100 * KMH), *sender(5, range(1), phase=0.05))
    assert judged.decoder.sources == {"BROADCAST.Speed": 5}
    assert judged.contested == [{}]
    assert len(judged.known(0)) == 50
    assert judged.decoder.rejected == {"BROADCAST: other source address": 1}


def test_a_sender_without_a_value_is_not_taken():
    judged = Judged(**SPEED).feed(broadcast(0, 7, 0xFFFF), broadcast(1, 5, 0xFFFF), broadcast(2, 5, 100 * KMH))
    assert judged.known(0) == pytest.approx([100 / 3.6])
    assert judged.decoder.sources == {"BROADCAST.Speed": 5}
    assert judged.decoder.rejected == {"BROADCAST: other source address": 1, "BROADCAST.Speed: not available": 1}


@pytest.mark.parametrize(("release", "first"), [(5.0, 1), (10.0, 1), (20.0, 3)])
def test_a_silent_sender_is_given_up_for_another_after_the_time_in_the_settings(release: float, first: int):
    rows = [broadcast(0.0, 7, 60 * KMH), *sender(5, range(1, 6))]
    judged = Judged(**SPEED, bus={"release_s": release}).feed(*rows, blocks=6)
    assert [bool(judged.known(block)) for block in range(6)] == [True, *(block >= first for block in range(1, 6))]
    assert judged.replaced.index(True) == first
    assert judged.contested == [{}] * 6
    assert judged.decoder.sources == {"BROADCAST.Speed": 5}


def test_a_sender_is_kept_while_no_other_sends():
    judged = Judged(**SPEED).feed(*sender(5, range(1)), *sender(5, range(8, 9)), blocks=9)
    assert len(judged.known(8)) == 50
    assert not any(judged.replaced)


def test_one_that_was_heard_to_agree_takes_over_without_a_new_window():
    rows = [*sender(5, range(2)), *sender(7, range(6), phase=0.05)]
    judged = Judged(**SPEED).feed(*rows, blocks=6)
    assert judged.decoder.sources == {"BROADCAST.Speed": 7}
    assert not any(judged.replaced)


def test_one_that_begins_in_the_block_in_which_the_other_ends_has_not_agreed():
    rows = [*sender(5, range(2)), *sender(7, range(1, 6), phase=0.0)]
    rows = [row for row in rows if (row[1] & 0xFF == 5) == (row[0] < 7.0)]
    judged = Judged(**SPEED).feed(*rows, blocks=6)
    assert judged.decoder.sources == {"BROADCAST.Speed": 7}
    assert judged.replaced == [block == 3 for block in range(6)]


def test_the_configured_sender_is_taken_whatever_others_send():
    rows = [*sender(7, range(6), factor=1.3, rate=50), *sender(5, range(4), phase=0.005)]
    judged = Judged(**SPEED, bus={"source_addresses": {"BROADCAST": 5}}).feed(*rows, blocks=6)
    assert judged.contested == [{}] * 6
    assert [len(judged.known(block)) for block in range(6)] == [50, 50, 50, 50, 0, 0]


# Two senders


@pytest.mark.parametrize("factor", [0.9, 1.05, 1.3])
def test_senders_that_disagree_are_both_left_out_until_one_has_been_silent_for_the_time_in_the_settings(factor: float):
    rows = [*sender(5, range(12)), *sender(7, range(2, 4), factor, phase=0.05)]
    judged = Judged(**SPEED, bus={"contest_s": 20}).feed(*rows, blocks=12)
    disagree_at = [bool(contested) for contested in judged.contested]
    assert disagree_at == [False, False, *[True] * 5, *[False] * 5]
    assert judged.contested[2] == {"BROADCAST.Speed": "senders disagree"}
    assert [bool(judged.known(block)) for block in range(12)] == [not at for at in disagree_at]
    assert judged.decoder.rejected["BROADCAST.Speed: contested, senders disagree"] == 5 * 50
    assert not any(judged.replaced)
    assert judged.decoder.sources == {"BROADCAST.Speed": 5}


def test_a_sender_that_outlasts_the_one_that_was_believed_replaces_it():
    rows = [*sender(5, range(3), 1.3), *sender(7, range(2, 14), phase=0.05)]
    judged = Judged(**SPEED).feed(*rows, blocks=14)
    over = judged.replaced.index(True)
    assert over == 8
    assert judged.decoder.sources == {"BROADCAST.Speed": 7}
    assert [bool(judged.known(block)) for block in range(14)] == [block < 2 or block >= over for block in range(14)]


def test_senders_that_agree_within_their_calibration_do_no_harm():
    rows = [*sender(5, range(6)), *sender(7, range(6), factor=1.01, phase=0.05)]
    judged = Judged(**SPEED).feed(*rows, blocks=6)
    assert judged.contested == [{}] * 6
    assert all(len(judged.known(block)) == 50 for block in range(6))


def test_a_frame_now_and_then_from_another_address_does_no_harm():
    rows = [*sender(5, range(6)), *(broadcast(t + 0.05, 7, 200 * KMH) for t in np.arange(0.0, 30, 2.5).tolist())]
    judged = Judged(**SPEED).feed(*rows, blocks=6)
    assert judged.contested == [{}] * 6
    assert all(len(judged.known(block)) == 50 for block in range(6))


@pytest.mark.parametrize(
    ("rate", "factor", "reason"),
    [
        (10, 1.1, "values alternate"),
        (10, 1.02, "values alternate"),
        (40, 1.1, "values alternate"),
        (40, 1.02, "values alternate"),
        (20, 1.0, "faster than its own rate"),
    ],
)
def test_a_second_sender_under_the_same_address_is_noticed(rate: float, factor: float, reason: str):
    rows = [*sender(5, range(16)), *sender(5, range(4, 6), factor, rate=rate, phase=0.03)]
    judged = Judged(**SPEED).feed(*rows, blocks=16)
    contested = [bool(found) for found in judged.contested]
    assert contested == [4 <= block < 11 for block in range(16)]
    assert reason in {found.get("BROADCAST.Speed") for found in judged.contested[4:6]}
    assert [bool(judged.known(block)) for block in range(16)] == [not each for each in contested]
    assert not any(judged.replaced)


def test_a_second_sender_from_the_first_frame_on_is_noticed():
    rows = [*sender(5, range(4)), *sender(5, range(4), 1.1, phase=0.05)]
    judged = Judged(**SPEED).feed(*rows, blocks=4)
    assert all(judged.contested)
    assert not any(judged.known(block) for block in range(4))


def test_a_new_rate_that_contradicts_nothing_is_accepted_after_ten_minutes():
    rows = [*sender(5, range(4)), *sender(5, range(4, 150), rate=20)]
    judged = Judged(**SPEED).feed(*rows, blocks=150)
    assert judged.contested[4] == {"BROADCAST.Speed": "faster than its own rate"}
    assert judged.contested[-1] == {}
    assert len(judged.known(-1)) == 100


def test_no_group_comes_faster_than_the_standard_allows():
    assert fastest(None) == fastest(0.02) == pytest.approx(120)
    assert fastest(0.1) == 60
    assert fastest(0.05) == 80


def test_contests_that_follow_each_other_last_longer():
    contest, ends, t = Contest(30.0), [], 0.0
    for _ in range(8):
        began = t
        contest.extend("reason", t, 1.0)
        while not contest.is_over(t):
            t += 5.0
        contest.settle()
        ends.append(t - began)
        t += 60.0
    assert ends == [30, 60, 120, 240, 480, 600, 600, 600]
    contest.extend("reason", t + 1e5, 1.0)
    assert contest.is_over(t + 1e5 + 30)


# A constant


def test_a_reference_torque_is_taken_from_any_address_that_sends_the_same():
    rows = [*torque(0, 0, 5, 10), *torque(7, 2, 7, 12)]
    judged = Judged(**TORQUE).feed(*rows, blocks=4)
    assert judged.contested == [{}] * 4
    assert [value for block in judged.values for value in block] == [2500] * 6


@pytest.mark.parametrize("source", [0, 0x21])
def test_one_other_reference_torque_is_contested_and_then_forgotten(source: int):
    rows = [*torque(0, *range(0, 90, 5)), *torque(source, 12.2, value=3250)]
    judged = Judged(**TORQUE).feed(*rows, blocks=18)
    contested = [bool(found) for found in judged.contested]
    assert contested == [2 <= block < 8 for block in range(18)]
    assert [judged.known(block) for block in range(18)] == [[] if each else [2500] for each in contested]
    assert not any(judged.replaced)


def test_a_wrong_reference_torque_that_came_first_is_given_up():
    rows = [*torque(0x21, 0, value=3250), *torque(0, *range(8, 90, 5))]
    judged = Judged(**TORQUE).feed(*rows, blocks=18)
    assert judged.known(0) == [3250]
    over = judged.replaced.index(True)
    assert judged.contested[over - 1]
    assert judged.contested[over] == {}
    assert [value for block in range(1, 18) for value in judged.known(block)] == [2500] * len(
        [1 for block in range(over, 18) if judged.known(block)]
    )
    assert judged.decoder.sources == {"LARGE.Torque": 0}


def test_reference_torques_that_go_on_to_contradict_each_other_stay_contested():
    rows = [*torque(0, *range(0, 90, 5)), *torque(0, *range(1, 90, 5), value=3250)]
    judged = Judged(**TORQUE).feed(*rows, blocks=18)
    assert all(judged.contested)
    assert not any(judged.known(block) for block in range(18))


def test_a_reference_torque_stays_known_when_the_senders_are_chosen_anew():
    judged = Judged(**TORQUE).feed(*torque(0, 0))
    judged.decoder.release()
    judged.feed(*torque(0x21, 5, value=3250))
    assert judged.contested[-1] == {"LARGE.Torque": "a constant changed"}


def test_the_reference_torque_of_another_vehicle_is_not_that_of_the_last():
    judged = Judged(**TORQUE).feed(*torque(0, 0))
    judged.decoder.release(is_other_vehicle=True)
    judged.feed(*torque(0, 5, value=1500))
    assert judged.contested[-1] == {}
    assert judged.known(1) == [1500]


# Roles that several nodes serve, and several roles of one signal


def test_the_torque_of_every_retarder_counts():
    """That of the engine does nothing, and the one on the driveline brakes."""
    rows = [broadcast(0.1 * k, 0x0F + k % 2, 0, fraction=125 if k % 2 else 0) for k in range(50)]
    judged = Judged(signals={"retarder_fraction": "BROADCAST.Fraction"}).feed(*rows)
    assert judged.contested == [{}]
    assert set(judged.values[0]) == {0.0, 1.25}
    assert judged.decoder.rejected == {}


@pytest.mark.parametrize("roles", [("speed", "gps_speed"), ("gps_speed", "speed")])
def test_a_signal_of_two_roles_is_judged_as_the_stricter_one_is(roles: tuple[str, str]):
    rows = [broadcast(0.1 * k, 7 * (k % 2), 30 * KMH * (1 + k % 2)) for k in range(300)]
    judged = Judged(signals=dict.fromkeys(roles, "BROADCAST.Speed")).feed(*rows, blocks=6)
    assert "BROADCAST.Speed" in judged.contested[-1]


# All inputs together


def test_while_one_input_is_contested_no_input_of_the_road_load_is_passed_on():
    tables = {"signals": {**SPEED["signals"], **TORQUE["signals"], **SWITCH["signals"]}}
    config = from_dict(tables)
    decoder = Decoder(bind(config, TRUCK), config.bus)
    rows = [*sender(5, range(1)), *torque(0, 0), *torque(0x21, 1, value=3250)]
    found = decoder.decode(pack(*sorted(rows, key=lambda row: row[0])), BLOCK)
    assert decoder.contested == {"LARGE.Torque": "a constant changed"}
    assert np.isnan(found[Role.SPEED][0].value).all()
    assert decoder.rejected["speed: another input is contested"] == 50


@pytest.mark.parametrize("changes", [8, 12])
def test_a_switch_that_flickers_is_contested(changes: int):
    states = [k * (changes + 1) // 50 % 2 for k in range(50)]
    rows = [broadcast(0.1 * k, 5, 60 * KMH, switch=state) for k, state in enumerate(states)]
    judged = Judged(**SWITCH).feed(*rows)
    assert judged.contested == [{"BROADCAST.Switch": "values alternate"} if changes > 10 else {}]


def test_a_contest_and_what_was_believed_outlast_a_restart():
    before = Judged(**SPEED).feed(*sender(5, range(3)), *sender(7, range(2, 3), 1.3, phase=0.05), blocks=3)
    after = Judged(**SPEED)
    after.decoder.restore(before.decoder.state())
    assert after.decoder.contested == before.contested[-1] != {}
    after._end = 3 * BLOCK
    after.feed(*sender(5, range(3, 11)), blocks=8)
    assert [bool(found) for found in after.contested] == [True] * 5 + [False] * 3
    assert not any(after.replaced)


NO_REASON = {"reason": "no reason", "before": None, "until": None, "duration": 30.0}


@pytest.mark.parametrize(
    "damage",
    [
        {"choices": {}},
        {"choices": {"BROADCAST.Speed": {"source": 256}}},
        {"contested": {"OTHER.Signal": "values alternate"}},
        {"contested": 1},
        {"contested": {"BROADCAST.Speed": "no reason"}},
        {"choices": {"BROADCAST.Speed": {"source": 5, "contest": NO_REASON}}},
    ],
)
def test_a_state_that_is_none_is_refused(damage: dict):
    decoder = Judged(**SPEED).decoder
    with pytest.raises(StateError):
        decoder.restore(decoder.state() | damage)


# Honest senders


@pytest.mark.slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32),
    n=st.integers(1, 300),
    noise=st.floats(0, 0.01),
    step=st.sampled_from([0.0, 1e-3, 0.01]),
    swing=st.floats(0, 0.5),
    period=st.floats(20, 500),
)
def test_no_smooth_signal_with_noise_and_resolution_alternates(seed, n, noise, step, swing, period):
    """``swing`` and ``noise`` are shares of the magnitude, ``period`` is in readings."""
    rng = np.random.default_rng(seed)
    value = 1 + swing * np.sin(2 * np.pi * np.arange(n) / period) + rng.normal(0, noise, n)
    value = np.round(value / step) * step if step else value
    assert not are_alternating(value, np.array([0, n]), 1.0, step)


@pytest.mark.slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32),
    times=st.integers(1, 10),
    lie=st.sampled_from([0.7, 0.9, 1.1, 1.3]),
    step=st.sampled_from([0.0, 1e-3, 0.01]),
)
def test_a_lie_in_between_alternates_however_often_it_comes(seed, times, lie, step):
    rng = np.random.default_rng(seed)
    true = 1 + 0.2 * np.sin(2 * np.pi * np.arange(60) / 50) + rng.normal(0, 0.003, 60)
    value = np.column_stack([true, *[lie * true] * times]).ravel()
    value = np.round(value / step) * step if step else value
    assert are_alternating(value, np.array([0, len(value)]), 1.0, step)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(lateness=st.floats(-0.3, 0.3), slope=st.floats(-0.2, 0.2), factor=st.floats(0.985, 1.015))
def test_senders_that_differ_by_lateness_and_calibration_agree(lateness, slope, factor):
    t = np.arange(50) * 0.1
    assert is_disagreement(t, 1 + slope * t / 5, t, factor * (1 + slope * (t - lateness) / 5), 1.0, 0.0) is False
    assert is_disagreement(t, np.ones(50), t + 5, np.ones(50), 1.0, 0.0) is None


# Times without traffic, and other recordings


def test_a_sender_can_be_replaced_in_a_silence(layouts: Path):
    rows = [*torque(0x21, 0, value=3250), *torque(0, 8, 13, 18), *sender(5, range(4, 5)), *sender(5, range(10, 13))]
    traffic = stream(layouts)
    items = list(traffic.feed(pack(*sorted(rows, key=lambda row: row[0]))))
    (replaced,) = [item for item in items if isinstance(item, Interruption) and item.is_sender_replaced]
    assert replaced.start is not None
    assert not any(replaced.start <= t < replaced.end for t, _, _ in rows)
    assert traffic.contested == {}


def test_a_step_back_in_time_ends_a_contest_and_frees_the_sender(layouts: Path):
    later = [*sender(5, range(4)), *sender(7, range(2, 4), 1.3, phase=0.05)]
    traffic = stream(layouts)
    list(traffic.feed(pack(*sorted((t + 86400, ident, data) for t, ident, data in later))))
    assert traffic.contested
    list(traffic.feed(pack(*sender(9, range(4)))))
    assert traffic.contested == {}
    assert traffic.sources["BROADCAST.Speed"] == 9


# Batches


traffic = st.lists(
    st.tuples(st.just("broadcast"), st.integers(0, 2), st.sampled_from([0, 256, 0xFE00, 0xFFFF]), st.integers(0, 3))
    | st.tuples(st.just("announce"), st.integers(0, 1), st.sampled_from([9, 21, 39]), st.just(0))
    | st.tuples(st.just("packet"), st.integers(0, 1), st.integers(1, 6), st.integers(0, 255))
    | st.tuples(st.just("large"), st.integers(0, 1), st.sampled_from([0, 100, 0xFFFF]), st.just(0))
    | st.tuples(st.just("short"), st.integers(0, 1), st.integers(0, 7), st.just(0))
    | st.tuples(st.just("pause"), st.integers(1, 20), st.just(0), st.just(0)),
    max_size=40,
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, derandomize=True)
@given(traffic, st.lists(st.integers(0, 200), max_size=6))
def test_how_traffic_is_cut_into_batches_changes_nothing(layouts: Path, events: list, places: list[int]):
    rows: list[Row] = []
    t = 0.0
    for kind, source, a, b in events:
        t = max(t, rows[-1][0] if rows else 0.0) + (float(source) if kind == "pause" else 0.1)
        if kind == "broadcast":
            rows.append(broadcast(t, source, a, b))
        elif kind == "announce":
            rows.append(announced(t, source, LARGE, bytes(a))[0])
        elif kind == "packet":
            rows.append((t, 0x1CEBFF00 | source, bytes([a]) + bytes([b]) * 7))
        elif kind == "large":
            rows += torque(source, t, value=a)
        elif kind == "short":
            rows.append((t, 0x18FEF100 | source, bytes(a)))
    frames = pack(*rows)
    assert heard(layouts, [frames]) == heard(layouts, cut(frames, places))


@pytest.fixture(scope="module")
def layouts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("layouts") / "truck.dbc"
    path.write_text(TRUCK.as_dbc_string(), newline="")
    assert isinstance(load_database([str(path)]), cantools.database.can.Database)
    return path


def stream(layouts: Path) -> RowStream:
    signals = {**SPEED["signals"], "brake_switch": "BROADCAST.Switch", **TORQUE["signals"]}
    return RowStream(from_dict({"bus": {"dbc": [str(layouts)]}, "signals": signals}))


def heard(layouts: Path, batches: list[Frames]) -> tuple:
    """All readings of a stream, its counts, senders and contests."""
    traffic = stream(layouts)
    blocks = [item for batch in batches for item in traffic.feed(batch)] + list(traffic.finish())
    readings = sorted(
        (role, t, str(value))
        for block in blocks
        if isinstance(block, Block)
        for role, parts in block.readings.items()
        for series in parts
        for t, value in zip(series.t.tolist(), series.value, strict=True)
    )
    return readings, dict(traffic.errors), traffic.sources, traffic.contested, traffic.used
