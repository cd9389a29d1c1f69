"""The road that a fleet learns by place, and its use by the next drive."""

from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import BytesIO, StringIO
from itertools import pairwise
from math import pi
from pathlib import Path

import msgspec
import numpy as np
import pytest
from dense_road import Dense, dense_field, observed, strides_of
from numpy.testing import assert_allclose, assert_array_equal

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.main import main
from estimator.config import Config, estimation_key, from_dict, load
from estimator.errors import ConfigError
from estimator.estimates import Estimate
from estimator.estimation.road_fit import fit
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.road_passes import MAX_SHARE, mean_slopes
from estimator.fleet.engine import Serial
from estimator.fleet.output import prepare, write_fleet
from estimator.fleet.passes import UNIT, Passes
from estimator.fleet.road import learned
from estimator.fleet.run import Fleet, run_fleet
from estimator.fleet.sources import find_logs
from estimator.model.road import RoadModel
from estimator.road_map import LAYOUT, RoadMap, cells_at, centre_of, key_of, octant_of, place_of
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Quantity, Role
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth
from estimator.streaming.course import Course
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block, RowStream
from estimator.strides import Strides
from estimator.units import EARTH_RADIUS, STANDARD_GRAVITY

pytestmark = pytest.mark.slow
MINUTES = 15
LEVELS = frozenset({Role.GRADE, Role.LONGITUDINAL_ACCELERATION})
HIDDEN = LEVELS | {Role.ALTITUDE}
ROAD = generate_route("mixed", 60e3, np.random.default_rng(1), grade_sd=0.015)
FLEET = {
    "truck-1": (Truck(mass=20_000.0, A=1240.0, C=4.0), Sensors(altitude_noise=0.3, without=LEVELS)),
    "truck-2": (Truck(mass=32_000.0, A=2180.0, C=5.0), Sensors(without=HIDDEN)),
}
NEXT = Truck(mass=24_000.0, A=1800.0, C=5.5)


@dataclass(frozen=True)
class Learned:
    """A fleet, the folder that it was written to, and the true quantities of one of its drives."""

    fleet: Fleet
    out: Path
    truth: Truth


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A drive of each truck over the same road, as J1939 frames."""
    folder = tmp_path_factory.mktemp("logs")
    for i, (name, (truck, sensors)) in enumerate(FLEET.items()):
        driven = record(truck, ROAD, 60.0 * MINUTES, np.random.default_rng([1, i]), sensors=sensors)
        frames = frames_of(driven.signals)
        (folder / name).mkdir()
        write_log(replace(frames, t=frames.t + 86_400.0 * i), folder / name / "a.blf")
    return folder, driven.truth


@pytest.fixture(scope="module")
def road(logs: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> Learned:
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    folder, truth = logs
    found = run_fleet(find_logs([str(folder)]).logs, Config(), Serial())
    out = tmp_path_factory.mktemp("fleet")
    prepare(out)
    write_fleet(found, Config(), out, 0.05)
    return Learned(found, out, truth)


@pytest.fixture(scope="module")
def next_drive() -> Frames:
    """Another truck on the same road; its bus shows no slope."""
    sensors = Sensors(without=HIDDEN)
    return frames_of(record(NEXT, ROAD, 60.0 * MINUTES, np.random.default_rng([1, 9, 0]), sensors=sensors).signals)


def with_map(path: Path) -> Config:
    return from_dict({"road": {"map": str(path)}})


def last_estimate(frames: Frames, config: Config) -> Estimate:
    pipeline = Pipeline(config)
    return [*pipeline.feed(frames), *pipeline.finish()][-1]


def true_slopes(truth: Truth) -> dict[int, float]:
    """Mean slope of each place of which 40 m were driven."""
    latitude, longitude = truth.position
    key = key_of(*cells_at(latitude, longitude), octant_of(truth.heading))
    places, number = np.unique(key, return_inverse=True)
    steps = np.diff(truth.s, prepend=0.0)
    length = np.bincount(number, steps)
    rise = np.bincount(number, steps * truth.grade)
    return {int(place): r / m for place, r, m in zip(places, rise, length, strict=True) if m > 40.0}


# The statistics of one drive.


@pytest.mark.parametrize("shown", [(), ("grade",)])
def test_slopes_of_parts_are_those_of_the_dense_gaussian_without_its_prior(shown: Sequence[str]) -> None:
    strides = strides_of(70, seed=3, shown=shown, silence=45)
    found = fit(strides)
    assert found is not None
    parts = np.full(len(strides), -1)
    parts[5:13], parts[20:28], parts[50:60] = 0, 1, 2
    by_hand = dense_slopes(strides, parts, found)
    got = mean_slopes(strides, found, parts)
    unknown = np.isnan(by_hand[0])
    assert not unknown.all()
    assert_array_equal(np.isnan(got.slope), unknown)
    for each, expected in zip((got.slope, got.own, got.common), by_hand, strict=True):
        assert_allclose(each[~unknown], expected[~unknown], rtol=2e-3, atol=1e-7)


def dense_slopes(strides: Strides, parts: Floats, found) -> tuple[Floats, Floats, Floats]:
    """Slope, own and common sd of each part, with dense matrices."""
    scales = found.scales
    model = RoadModel(strides, scales.alpha, scales.wander, designed=scales.designed)
    likelihood = Likelihood(model, (), found.road_load, scales.lag, (), found.taken)
    dense, data = Dense(model, scales.values), likelihood.data[observed(model)]
    theta = dense_field(replace(model.nodes, s=model.along), scales.alpha, scales.values[4], scales.values[5])
    identity = np.eye(len(theta))
    seen = [-STANDARD_GRAVITY * dense.hats, *(identity[reading.nodes] for reading in model.readings)]
    gain = np.linalg.solve(dense.K, np.vstack(seen) @ theta).T
    left = theta - gain @ np.vstack(seen) @ theta
    means = []
    for part in range(int(parts.max()) + 1):
        inside = strides[parts == part]
        at = np.array([np.interp(0.5 * (inside.s0 + inside.s1), model.nodes.s, row) for row in identity]).T
        means.append((inside.s1 - inside.s0) @ at / (inside.s1 - inside.s0).sum())
    W = np.array(means)
    beta = found.beta * likelihood.unit
    covariance = found.covariance * np.outer(likelihood.unit, likelihood.unit)
    posterior, prior = np.diag(W @ left @ W.T), np.diag(W @ theta @ W.T)
    information = np.where(posterior < MAX_SHARE * prior, 1 / posterior - 1 / prior, np.nan)
    own = 1 / information
    slope = W @ gain @ (data[:, 0] - data[:, 1:] @ beta) / posterior * own
    turned = W @ gain @ data[:, 1:]
    common = np.sqrt(np.einsum("ki,ij,kj->k", turned, covariance, turned)) / posterior * own
    return slope, np.sqrt(own), common


def test_passes_are_kept_in_few_bytes(road: Learned) -> None:
    for result in road.fleet.results:
        kept = msgspec.json.encode(result.passes)
        assert msgspec.json.decode(kept, type=Passes) == result.passes
        assert len(result.passes.row) > 40
        assert len(kept) < 22 * len(result.passes.row)


def test_passes_come_back_from_their_differences() -> None:
    key = key_of(np.array([5, -7, 5]), np.array([9, 0, 8]), np.array([7, 0, 3]))
    slope, own, common = np.array([0.01, -0.02, 0.0]), np.array([1e-3, 2e-3, 0.0]), np.array([1e-4, 0.05, 1e-9])
    passes = Passes.of(key, slope, own, common)
    assert_array_equal(passes.keys, key)
    for got, expected in zip(passes.values, (slope, np.maximum(own, UNIT), np.maximum(common, UNIT)), strict=True):
        assert_allclose(got, expected, atol=0.51 * UNIT)
    again = Passes.joined([passes, passes])
    assert_array_equal(again.keys, np.tile(key, 2))
    assert_array_equal(again.values[0], np.tile(passes.values[0], 2))


# All passes of a place.


def passes_at(places: Sequence[int], slopes: Sequence[float], own: Sequence[float], common: Sequence[float]) -> Passes:
    key = key_of(np.zeros(len(places), np.int64), np.array(places), np.zeros(len(places), np.int64))
    return Passes.of(key, np.array(slopes), np.array(own), np.array(common))


def test_passes_are_joined_by_their_own_precision_and_keep_their_common_error() -> None:
    found = learned(
        ["a", "a", "b"],
        [passes_at([1, 2], [0.010, 0.03], [0.001, 0.002], [0.002, 0.001]),
         passes_at([1], [0.013], [0.002], [0.002]),
         passes_at([1], [0.011], [0.001], [0.004])],
    )  # fmt: skip
    # By hand: weights 1 : 1/4 : 1 of the first place; with two passes the sd is that of 1 / 1.25 and 0.002 in common,
    # 2.19e-3, with three that of 1 / 2.25 and (1.25 * 0.002 + 0.004) / 2.25, 2.97e-3: the third is left out.
    mean = (0.010 + 0.013 / 4) / 1.25
    variance = 1e-6 / 1.25 + 0.002**2
    off = np.array([0.010, 0.013, 0.011]) - mean
    assert (off**2 / [5e-6, 8e-6, 17e-6]).sum() / 2 < 1  # they scatter by no more than their sds
    assert_allclose(found.slope, [mean, 0.03], rtol=1e-9)
    assert_allclose(found.sd, [np.sqrt(variance), np.hypot(0.002, 0.001)], rtol=1e-9)
    assert_allclose(found.common, [0.002, 0.001], rtol=1e-9)
    assert_allclose(found.scatter, [np.sqrt((off**2).sum() / 2), np.nan], rtol=1e-9)
    assert found.passes.tolist() == [3, 1]
    assert found.vehicles.tolist() == [2, 1]


def test_passes_that_contradict_each_other_widen_the_sd() -> None:
    agreed, off = (
        learned(["a", "b"], [passes_at([1], [z], [0.001], [0.0]) for z in both]) for both in ([0, 1e-3], [0, 1e-2])
    )
    assert agreed.sd[0] == pytest.approx(1e-3 / np.sqrt(2), rel=1e-3)
    excess = 2 * 0.005**2 / (1e-3**2 + UNIT**2)
    assert off.sd[0] == pytest.approx(agreed.sd[0] * np.sqrt(excess), rel=1e-3)


def test_more_passes_of_one_vehicle_do_not_average_what_they_have_in_common() -> None:
    one, many = (learned(["a"] * n, [passes_at([1], [0.01], [0.001], [0.003]) for _ in range(n)]) for n in (1, 1000))
    assert one.sd[0] == pytest.approx(np.hypot(0.001, 0.003), rel=1e-6)
    assert many.sd[0] == pytest.approx(0.003, rel=1e-3)


def test_no_passes_are_no_road() -> None:
    found = learned(["a"], [Passes()])
    assert not len(found.key)
    assert not len(found.map.key)


# A fleet over one road.


def test_the_learned_slopes_are_the_true_ones_within_their_sd(road: Learned) -> None:
    import pyarrow.parquet

    truth = true_slopes(road.truth)
    table = pyarrow.parquet.read_table(road.out / "road.parquet")
    columns = {name: np.array(column) for name, column in table.to_pydict().items()}
    cells = cells_at(np.radians(columns["latitude"]), np.radians(columns["longitude"]))
    key = key_of(*cells, octant_of(np.radians(columns["course"])))
    assert_array_equal(key, road.fleet.road.key)
    assert table.schema.field("slope_sd").metadata[b"unit"] == b"1"
    there = np.array([int(k) in truth for k in key])
    assert there.sum() >= 0.9 * len(truth)
    error = columns["slope_mean"][there] - [truth[int(k)] for k in key[there]]
    sd = columns["slope_sd"][there]
    assert np.std(list(truth.values())) > 0.01
    assert np.sqrt(np.mean(error**2)) < 0.0016
    assert np.mean(np.abs(error) < 2 * sd) > 0.85
    assert 0.5 < np.sqrt(np.mean((error / sd) ** 2)) < 1.4
    assert set(columns["vehicles"].tolist()) <= {1, 2}
    assert np.median(columns["passes"]) == 2


def test_duckdb_finds_the_steepest_places_driven_twice(road: Learned) -> None:
    duckdb = pytest.importorskip("duckdb")
    found = duckdb.sql(
        f"select latitude, longitude, slope_mean from '{road.out}/road.parquet' "
        "where passes > 1 order by abs(slope_mean) desc limit 5"
    ).fetchall()
    learned_road = road.fleet.road
    twice = np.sort(np.abs(learned_road.slope[learned_road.passes > 1]))
    assert [abs(slope) for _, _, slope in found] == pytest.approx(twice[::-1][:5].tolist())
    rows, columns = cells_at(*np.radians([place[:2] for place in found]).T)
    places = {place_of(int(key))[:2] for key in learned_road.key}
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) <= places


def test_hidden_hills_leave_slopes_whose_level_is_unknown_and_that_no_map_takes(road: Learned) -> None:
    shown, hidden = road.fleet.results
    assert np.median(shown.passes.values[2]) < 5e-4
    assert np.median(hidden.passes.values[2]) > 2e-3
    alone = learned(["truck-2"], [hidden.passes])
    assert len(alone.key)
    assert not len(alone.map.key)


def test_the_next_drive_knows_A_and_C_by_the_map(road: Learned, next_drive: Frames) -> None:
    without, found = (last_estimate(next_drive, c) for c in (Config(), with_map(road.out / "road.npy")))
    assert without.A is None
    assert found.mass is not None
    assert found.A is not None
    assert found.C is not None
    assert found.road is not None
    assert found.road.shown_by == ("grade",)
    for got, true in ((found.mass, NEXT.mass), (found.A, NEXT.A), (found.C, NEXT.C)):
        assert abs(got.mean - true) < 2.5 * got.sd
    assert found.A.sd < 0.15 * NEXT.A
    assert found.C.sd < 0.3 * NEXT.C
    assert without.mass is not None
    assert found.mass.sd < without.mass.sd


def test_a_map_of_another_place_changes_nothing(road: Learned, next_drive: Frames, tmp_path: Path) -> None:
    row, column, octant = place_of(road.fleet.road.map.key)
    elsewhere = replace(road.fleet.road.map, key=key_of(row - 500, column, octant))
    (tmp_path / "road.npy").write_bytes(elsewhere.encoded())
    short = next_drive[: len(next_drive) // 2]
    assert last_estimate(short, with_map(tmp_path / "road.npy")) == last_estimate(short, Config())


def test_a_grade_signal_of_the_bus_counts_for_more_than_the_map(road: Learned, next_drive: Frames) -> None:
    config = from_dict(
        {"signals": {**Config().binding, "grade": "SSI.PitchAngle"}, "road": {"map": str(road.out / "road.npy")}}
    )
    for rows in rows_of([next_drive[: len(next_drive) // 3]], config):
        assert Quantity.GRADE_OFFSET_SD not in rows.derived


def rows_of(batches: Sequence[Frames], config: Config) -> Iterator[Rows]:
    for item in RowStream(config).feed_all(batches):
        if isinstance(item, Block):
            yield from item.rows


def test_the_grade_of_the_map_does_not_depend_on_the_batches(road: Learned, next_drive: Frames) -> None:
    part, config = next_drive[: len(next_drive) // 3], with_map(road.out / "road.npy")
    cuts = [0, 1000, 1001, 20_000, len(part)]
    whole, pieces = (
        Rows.concatenate(*rows_of(batches, config)) for batches in ([part], [part[i:j] for i, j in pairwise(cuts)])
    )
    for role in (Role.GRADE, Role.LATITUDE):
        assert_array_equal(whole.context[role], pieces.context[role])
    offset_sd = Quantity.GRADE_OFFSET_SD
    assert_array_equal(whole.derived[offset_sd], pieces.derived[offset_sd])
    assert np.isfinite(whole.context[Role.GRADE]).mean() > 0.5


def test_with_a_map_nothing_is_learned(road: Learned, logs: tuple[Path, Truth], tmp_path: Path) -> None:
    """What was found with the map holds what the map knew."""
    config = with_map(road.out / "road.npy")
    found = run_fleet(find_logs([str(logs[0] / "truck-2")]).logs, config, Serial())
    assert found.results[0].segments[-1].parameters["A"].posterior is not None
    assert not len(found.road.key)
    prepare(tmp_path / "out")
    names = {path.name for path in write_fleet(found, config, tmp_path / "out", 0.05)}
    assert not names & {"road.parquet", "road.npy"}


def test_a_bus_without_position_teaches_no_road(tmp_path: Path) -> None:
    sensors = Sensors(without=LEVELS | {Role.LATITUDE, Role.LONGITUDE})
    driven = record(NEXT, ROAD, 240.0, np.random.default_rng(0), sensors=sensors)
    write_log(frames_of(driven.signals), tmp_path / "a.blf")
    found = run_fleet(find_logs([str(tmp_path)]).logs, Config(), Serial())
    assert not len(found.road.key)


# Places.


@pytest.mark.parametrize("latitude", [-89.9, -48.0, -0.0003, 0.0, 11.0, 48.0, 70.0])
@pytest.mark.parametrize("longitude", [-180.0, -179.9999, -11.0, 0.0, 11.0, 179.9999])
def test_cells_are_a_hundred_metres_wide(latitude: float, longitude: float) -> None:
    rng = np.random.default_rng(0)
    at, along = np.radians(latitude) + rng.uniform(0, 1e-4, 50), np.radians(longitude) + rng.uniform(0, 1e-4, 50)
    row, column = cells_at(at, along)
    middle, across = centre_of(row, column)
    apart = np.mod(across - along + pi, 2 * pi) - pi
    assert np.all(np.abs(at - middle) * EARTH_RADIUS < 50.001)
    assert np.all(np.abs(apart) * np.cos(middle) * EARTH_RADIUS < 75.0)  # near a pole a row has few columns
    assert_array_equal(np.column_stack(cells_at(middle, across)), np.column_stack([row, column]))
    octant = octant_of(rng.uniform(-9, 9, 50))
    for got, expected in zip(place_of(key_of(row, column, octant)), (row, column, octant), strict=True):
        assert_array_equal(got, expected)


def test_directions_are_eighths_of_a_turn() -> None:
    assert octant_of(np.radians([0, 22, 23, 90, 180, -90, 350, 730])).tolist() == [0, 0, 1, 2, 4, 6, 0, 0]


def rows_along(north: Floats, east: Floats, speed: float) -> Rows:
    n = len(north)
    context = {Role.LATITUDE: 0.8 + north / EARTH_RADIUS, Role.LONGITUDE: 0.2 + east / EARTH_RADIUS / np.cos(0.8)}
    return Rows(
        index=np.arange(n), speed=np.full(n, speed), power=np.zeros(n), fresh=np.ones((n, 2), bool), context=context
    )


def test_the_course_is_that_of_the_last_fifty_metres_and_unknown_before() -> None:
    way = 20.0 * STEP * np.arange(200)
    course = Course().feed(rows_along(-0.6 * way, 0.8 * way, 20.0))
    known = np.isfinite(course)
    assert 20 <= np.flatnonzero(known)[0] <= 30
    assert known[30:].all()
    assert_allclose(course[known], np.arctan2(0.8, -0.6), atol=1e-3)


def test_the_course_is_kept_while_the_vehicle_stands_and_forgotten_over_a_gap() -> None:
    finder, way = Course(), 20.0 * STEP * np.arange(100)
    finder.feed(rows_along(way, 0 * way, 20.0))
    jitter = np.random.default_rng(0).normal(0, 2.0, (2, 3000))
    standing = rows_along(way[-1] + jitter[0], jitter[1], 0.0)
    course = finder.feed(replace(standing, index=100 + standing.index))
    assert np.all(np.abs(course) < 0.3)
    assert np.isnan(finder.feed(replace(standing, index=9000 + standing.index))).all()


def test_a_map_is_looked_up_by_cell_and_direction() -> None:
    at = np.radians([48.0]), np.radians([11.0])
    key = key_of(*cells_at(*at), np.array([2]))
    found = RoadMap(key, np.array([0.03]), np.array([1e-4]))

    def slope(degrees: float) -> float:
        return float(found.at(*at, np.radians([degrees]))[0][0])

    assert [slope(degrees) for degrees in (90, 70, 110, 60, 120)] == [0.03] * 5  # the next octants as well
    for degrees in (20, 150, 270, np.nan):
        assert np.isnan(slope(degrees))
    assert np.isnan(found.at(at[0] + 1e-3, at[1], np.array([pi / 2]))[0][0])
    assert np.isnan(found.at(np.array([np.nan]), at[1], np.array([pi / 2]))[0][0])


def test_a_grade_whose_offset_sd_is_known_has_two_offsets_of_that_sd() -> None:
    strides = strides_of(40, shown=("grade",))
    likelihoods = [
        Likelihood(RoadModel(each, 2, 1), (), np.array([1500.0, 3.5, 20_000.0]), 6)
        for each in (strides, replace(strides, grade_offset_sd=np.full(40, 2e-4)))
    ]
    free, bound = (
        np.diag(likelihood.prior)[-likelihood.model.readings[0].offsets.shape[1] :] for likelihood in likelihoods
    )
    assert_allclose(free, [1.0])
    assert_allclose(bound, [2e-4**-2.0] * 2)
    constant, squares = likelihoods[1].model.readings[0].offsets.T
    assert_array_equal(constant, 1.0)
    assert squares.mean() == pytest.approx(1.0)
    assert np.std(squares) > 0.1


# The file.


def made_map() -> RoadMap:
    key = key_of(np.array([3, 3, 4]), np.array([5, 6, 0]), np.array([1, 1, 7]))
    return RoadMap(key, np.array([0.01, -0.02, 0.03]), np.array([1e-4, 2e-4, 3e-4]))


def test_a_map_comes_back_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "road.npy").write_bytes(made_map().encoded())
    found = RoadMap.read(tmp_path / "road.npy")
    assert_array_equal(found.key, made_map().key)
    assert_allclose(found.slope, made_map().slope, rtol=1e-6)
    assert_allclose(found.offset_sd, made_map().offset_sd, rtol=1e-6)
    assert np.load(tmp_path / "road.npy", allow_pickle=False).dtype == LAYOUT


def saved(array: object) -> bytes:
    file = BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def with_cell(name: str, value: float) -> bytes:
    records = np.load(BytesIO(made_map().encoded()))
    records[name][1] = value
    return saved(records)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "EOF"),
        (b"PK\x03\x04" + bytes(100), "magic string"),
        (made_map().encoded()[:-1], "3 places are promised"),
        (made_map().encoded() + b"\0", "3 places are promised"),
        (made_map().encoded().replace(b"(3,)", b"(9,)"), "9 places are promised"),
        (made_map().encoded()[:40], "EOF"),
        (saved(np.zeros(3)), "other columns"),
        (saved(np.zeros((3, 1), LAYOUT)), "other columns"),
        (saved(np.array([{}, {}])), "other columns"),
        (with_cell("slope", np.nan), "record 1"),
        (with_cell("slope", 0.6), "record 1"),
        (with_cell("offset_sd", 0.0), "record 1"),
        (with_cell("offset_sd", np.inf), "record 1"),
        (with_cell("octant", 8), "record 1"),
        (with_cell("column", -1), "record 1"),
        (with_cell("column", 10**6), "record 1"),
        (with_cell("row", 2), "record 1"),
        (with_cell("row", 2**31 - 1), "record 1"),
    ],
)
def test_a_damaged_map_is_one_line_that_names_it(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "road.npy"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="not a map of slopes: ") as caught:
        RoadMap.read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert reason in message
    assert "\n" not in message
    assert "road.npy of roadload fleet" in message


@pytest.mark.parametrize(("command", "content"), [("estimate", None), ("diagnose", b"nothing"), ("fleet", None)])
def test_commands_end_with_status_2(
    command: str, content: bytes | None, logs: tuple[Path, Truth], tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="the extra `fleet` is not installed")
    if content is not None:
        (tmp_path / "road.npy").write_bytes(content)
    (tmp_path / "c.toml").write_text('[road]\nmap = "road.npy"\n')
    log, out, err = logs[0] / "truck-1" / "a.blf", StringIO(), StringIO()
    more = ["-o", str(tmp_path / "out"), "--workers", "1"] if command == "fleet" else []
    with redirect_stdout(out), redirect_stderr(err):
        status = main([command, str(log), "--config", str(tmp_path / "c.toml"), *more])
    assert status == 2
    (line,) = err.getvalue().splitlines()
    assert str(tmp_path / "road.npy") in line


def test_the_map_is_relative_to_the_configuration_and_part_of_what_a_saved_state_depends_on(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('[road]\nmap = "fleet/road.npy"\n')
    config = load(path)
    assert config.road.map == str(tmp_path / "fleet/road.npy")
    with pytest.raises(ConfigError, match=r"correct road\.map"):
        estimation_key(config)
    (tmp_path / "fleet").mkdir()
    (tmp_path / "fleet/road.npy").write_bytes(made_map().encoded())
    one = estimation_key(config)
    (tmp_path / "fleet/road.npy").write_bytes(replace(made_map(), slope=np.zeros(3)).encoded())
    assert one != estimation_key(config) != estimation_key(Config())
    path.write_text("[road]\nmaps = 'a'\n")
    with pytest.raises(ConfigError, match="maps"):
        load(path)
