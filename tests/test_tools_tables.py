"""Tables become logs that say the same; another simulator's drives and real recordings are judged as they should be."""

import dataclasses
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import can
import cantools
import numpy as np
import pytest
from diagnoses import finding
from made_strides import made_strides
from msgspec.structs import replace
from scipy.ndimage import gaussian_filter1d

from estimator import config
from estimator.answers.diagnosis import Part, Verdict
from estimator.answers.run import RunAnswer
from estimator.answers.simulation import SimulationAnswer, Truth
from estimator.can_io.binding import load_database
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.log_writer import write_log
from estimator.diagnosis.result import Diagnosis, GapClosed
from estimator.errors import RoadloadError
from estimator.estimation import road_fit
from estimator.model.road_load import design
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.signals import Role
from estimator.streaming.replay import estimate_logs
from estimator.units import STANDARD_GRAVITY

TOOLS = Path(__file__).parents[1] / "tools"
ROOMS = (
    "table", "table_to_log", "vt_truck", "surrogate_drives", "real_recordings", "check_fastsim", "check_transfer",
    "dynamometer", "fastsim_world",
)  # fmt: skip
CAR = """VERSION ""
NS_ :
BS_:
BU_:
BO_ 256 MOTION: 3 Vector__XXX
 SG_ Speed : 7|16@0+ (0.01,0) [0|300] "km/h" Vector__XXX
 SG_ Mode : 16|4@1+ (1,0) [0|15] "" Vector__XXX
BO_ 257 MOTOR: 8 Vector__XXX
 SG_ Torque : 0|16@1- (0.5,0) [-400|400] "Nm" Vector__XXX
"""
TABLE = "t,v km/h,torque,car\n0.0,36,100,1\n1.0,,-20.5,1\n2.0,54.25,900,1\n3.0,60,0,2\n"


@pytest.fixture
def tools(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    import check_fastsim
    import check_transfer
    import dynamometer
    import fastsim_world.bus
    import fastsim_world.roads
    import fastsim_world.truck
    import real_recordings
    import surrogate_drives
    import table
    import table_to_log
    import vt_truck

    world = fastsim_world
    yield SimpleNamespace(
        table=table,
        to_log=table_to_log,
        vt=vt_truck,
        rolls=dynamometer,
        recordings=real_recordings,
        second=check_fastsim,
        pair=check_transfer,
        surrogates=surrogate_drives,
        roads=world.roads,
        truck=world.truck,
        bus=world.bus,
    )
    for name in [name for name in sys.modules if name.partition(".")[0] in ROOMS]:
        del sys.modules[name]


@pytest.fixture
def files(tmp_path):
    (tmp_path / "car.dbc").write_text(CAR)
    (tmp_path / "drive.csv").write_text(TABLE)
    return tmp_path


def run(tools, files, *arguments, table="drive.csv", log="drive.log"):
    command = [str(files / table), str(files / log), "--dbc", str(files / "car.dbc"), *arguments]
    return tools.to_log.main(command)


def messages(path):
    """Frames of a log as (time since EPOCH, id, payload), by python-can's own reader."""
    with can.LogReader(path) as log:
        return [(m.timestamp - EPOCH, m.arbitration_id, bytes(m.data)) for m in log]


def test_another_decoder_reads_the_table_back(tools, files, capsys):
    mapped = ("--map", "MOTION.Speed=v km/h", "--map", "MOTOR.Torque=torque", "--time", "t")
    assert run(tools, files, *mapped) == 0
    car = cantools.database.load_file(files / "car.dbc")
    seen = {"MOTION": {}, "MOTOR": {}}
    for t, ident, data in messages(files / "drive.log"):
        message = car.get_message_by_frame_id(ident)
        seen[message.name][round(t, 3)] = message.decode(data)
    # What is empty or out of range cannot be said by these messages, so the frame is not there.
    assert {t: content["Speed"] for t, content in seen["MOTION"].items()} == {0.0: 36.0, 2.0: 54.25, 3.0: 60.0}
    assert {t: content["Torque"] for t, content in seen["MOTOR"].items()} == {0.0: 100.0, 1.0: -20.5, 3.0: 0.0}
    said = capsys.readouterr().out
    assert "MOTION.Speed: 1 empty, 0 out of range: frame left out" in said
    assert "MOTOR.Torque: 0 empty, 1 out of range: frame left out" in said
    assert "nothing is mapped to Mode" in said


def test_j1939_says_not_available_and_keeps_the_rest_of_the_frame(tools, files):
    (files / "drive.csv").write_text("n,T,v\n1000,50,40\n1200,,50\n99999,60,\n")
    log = files / "drive.blf"
    table = tools.table.read_table(files / "drive.csv")
    mapping = ["EEC1.EngSpeed=n", "EEC1.ActualEngPercentTorque=T", "CCVS1.WheelBasedVehicleSpeed=v"]
    count, span, remarks = tools.to_log.convert(table, log, [], mapping, None, 10.0, [])
    assert (count, round(span, 6)) == (5, 0.2)
    engine = [data for _, ident, data in messages(log) if ident >> 8 & 0xFFFF == 0xF004]
    raw = [(int.from_bytes(data[3:5], "little"), data[2]) for data in engine]
    assert raw == [(8000, 175), (9600, 0xFF), (0xFFFF, 185)]
    assert all(data[0] == data[1] == data[7] == 0xFF for data in engine)
    assert remarks == [
        "EEC1.EngSpeed: 0 empty, 1 out of range: not available",
        "EEC1.ActualEngPercentTorque: 1 empty, 0 out of range: not available",
        "CCVS1.WheelBasedVehicleSpeed: 1 empty, 0 out of range: not available",
    ]


@pytest.mark.parametrize(
    ("expression", "expected"),
    [("a", 3.0), ("a*2", 6.0), ("a*-2.5e1", -75.0), ("a+1", 4.0), ("a*2-0.5", 5.5), ("a-1", 7.0), ("b (x/y)*2", 10.0)],
)
def test_columns_are_scaled(tools, tmp_path, expression, expected):
    (tmp_path / "x.csv").write_text("a,a-1,b (x/y)\n3,7,5\n")
    assert tools.table.read_table(tmp_path / "x.csv").scaled(expression).tolist() == [expected]


def test_rows_are_selected_and_keep_their_times(tools, files):
    assert run(tools, files, "--map", "MOTION.Speed=v km/h", "--rate", "2", "--select", "car=2.0") == 0
    assert [round(t, 6) for t, _, _ in messages(files / "drive.log")] == [1.5]


@pytest.mark.parametrize(
    ("table", "arguments", "words"),
    [
        ("t,v\n0,1\n1,fast\n", ["--time", "t", "--map", "MOTION.Speed=v"], "row 3, column 'v': 'fast' is not a number"),
        ("t,v\n0,1\n2,1\n1,2\n", ["--time", "t", "--map", "MOTION.Speed=v"], "row 4: time 1 after 2"),
        ("t,v\n0,1\n,1\n", ["--time", "t", "--map", "MOTION.Speed=v"], "row 3: time nan"),
        ("t,v\n0,1\n1\n", ["--time", "t", "--map", "MOTION.Speed=v"], "row 3 has 1 cells, the header has 2"),
        ("v,v\n0,1\n", ["--rate", "1", "--map", "MOTION.Speed=v"], "two columns are called 'v'"),
        ("t,v\n", ["--rate", "1", "--map", "MOTION.Speed=v"], "holds no rows"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOTION.Speed=w"], "no column 'w'; the columns are 't', 'v'"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOTION.Velocity=v"], "no such signal; it has Speed, Mode"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOVE.Speed=v"], "no such message; it has MOTION, MOTOR"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOTION=v"], "is not of the form"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOTION.Speed=v", "--map", "MOTION.Speed=t"], "is mapped twice"),
        ("t,v\n0,1\n", ["--rate", "1", "--map", "MOTION.Speed=v", "--select", "v=2"], "'v' holds 1"),
        ("t,v\n0,-1\n", ["--rate", "1", "--map", "MOTION.Speed=v"], "no frame is left; MOTION.Speed: 0 empty, 1 out"),
    ],
)
def test_bad_tables_are_one_line_and_no_log(tools, files, capsys, table, arguments, words):
    (files / "drive.csv").write_text(table)
    assert run(tools, files, *arguments) == 2
    assert not (files / "drive.log").exists()
    complaint = capsys.readouterr().err
    assert complaint.count("\n") == 1
    assert words in complaint


def test_a_message_of_many_frames_is_refused(tools, files):
    table = tools.table.read_table(files / "drive.csv")
    with pytest.raises(RoadloadError, match="39 bytes do not fit into one frame"):
        tools.to_log.frames_of_table(table, np.arange(4.0), load_database([]), ["EC1.EngReferenceTorque=torque"])


def test_parquet_reads_like_csv(tools, files):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet tables need pyarrow")
    from pyarrow import csv, parquet

    parquet.write_table(csv.read_csv(files / "drive.csv"), files / "drive.parquet")
    assert pyarrow is not None
    mapped = ("--map", "MOTION.Speed=v km/h", "--time", "t")
    assert run(tools, files, *mapped) == run(tools, files, *mapped, table="drive.parquet", log="other.log") == 0
    assert (files / "drive.log").read_text() == (files / "other.log").read_text()


@pytest.mark.skipif(find_spec("pyarrow") is not None, reason="pyarrow is installed")
def test_parquet_without_its_library_says_what_to_install(tools, files):
    with pytest.raises(RoadloadError, match="pip install pyarrow"):
        tools.table.read_table(files / "drive.parquet")


@pytest.mark.slow
def test_a_table_at_one_hertz_is_enough_for_the_estimator(tools, tmp_path):
    t = np.arange(3600.0)
    waves = [(5.0, 97.0), (3.0, 41.0), (2.0, 211.0)]
    v = 16 + sum(size * np.sin(2 * np.pi * t / period) for size, period in waves)
    a = sum(size * 2 * np.pi / period * np.cos(2 * np.pi * t / period) for size, period in waves)
    truth = np.array([1500.0, 3.5, 22_000.0])
    noise = np.random.default_rng(1).normal(0.0, 3e3, len(t))
    power = np.maximum(design(v, a) @ truth + noise, 0.0) / 1e3
    rows = zip((v / 0.44704).tolist(), power.tolist(), strict=True)
    (tmp_path / "truck.csv").write_text("mph,kW\n" + "\n".join(f"{x:.4f},{y:.4f}" for x, y in rows))
    table = tools.table.read_table(tmp_path / "truck.csv")
    mapping = ["MOTION.Speed=mph", "ENGINE.Power=kW"]
    tools.to_log.convert(table, tmp_path / "truck.blf", [str(TOOLS / "vt_truck.dbc")], mapping, None, 1.0, [])
    final = estimate_logs([tmp_path / "truck.blf"], config.load(TOOLS / "vt_truck.toml"), lambda share: None).final
    assert final.mass.mean == pytest.approx(truth[2], rel=0.02)
    assert final.A.mean == pytest.approx(truth[0], rel=0.1)
    assert final.C.mean == pytest.approx(truth[1], rel=0.1)


def truck_table(tools, phase, speed, elevation):
    columns = {"vel (mph)": speed, "fuel (g/s)": 0 * speed + 5, "engine (rpm)": 0 * speed + 1200}
    cells = columns | {"elevation (m)": elevation, "phase_num": phase}
    return tools.table.Table(
        Path("truck.csv"), list(range(2, len(speed) + 2)), {k: v.tolist() for k, v in cells.items()}
    )


def test_recordings_of_a_table_are_taken_apart(tools):
    phase = np.repeat([1, 2, 1], [200, 100, 100])
    speed, elevation = np.full(400, 50.0), np.arange(400.0) / 10
    elevation[80:] += 40.0  # rows are missing here, and a few moments later again
    speed[100:] += 10.0
    found = dict(tools.vt.recordings(truck_table(tools, phase, speed, elevation)))
    assert list(found) == ["1a", "2a", "1b"]
    assert [len(rows) for rows in found.values()] == [180, 100, 100]  # 20 rows between two jumps are no drive
    t, height = found["1a"].numbers("s"), found["1a"].numbers("elevation (m)")
    assert np.flatnonzero(np.diff(t) > 1).tolist() == [79]
    assert t[80] - t[79] > 100
    assert np.allclose(height[:80], elevation[:80])
    assert np.allclose(height[80:], elevation[100:200])


def test_without_fuel_the_power_of_the_truck_is_not_known(tools, tmp_path):
    t = np.arange(100.0)
    table = truck_table(tools, 0 * t + 1, 0 * t + 50, 0 * t)
    table.cells["fuel (g/s)"][40:60] = [0.0] * 20
    ((_, recording),) = tools.vt.recordings(table)
    tools.vt.write(recording, tmp_path / "truck.blf")
    ids = [message.arbitration_id for message in can.LogReader(tmp_path / "truck.blf")]
    assert (ids.count(256), ids.count(257), ids.count(258)) == (100, 80, 100)


@pytest.mark.slow
def test_a_car_on_rolls_has_the_mass_that_the_rolls_give_it(tools, recordings, tmp_path):
    """By least squares of the measured force it has 1,642 to 1,679 kg, by how the speed is differentiated.

    A is about 0 there, which is not an estimate.
    """
    log = tmp_path / "car.blf"
    tools.rolls.write(recordings / "argonne_d3" / "61506048.txt", log)
    found = tools.recordings.roadload(RunAnswer, "estimate", log, "--config", TOOLS / "dynamometer.toml").parameters
    assert found.mass_kg.mean == pytest.approx(1675, rel=0.01)
    assert found.mass_kg.sd < 0.01 * found.mass_kg.mean
    assert (found.A_N.status, found.A_N.mean) == ("unestimated", None)


@pytest.mark.slow
def test_a_real_truck_is_weighed_on_a_road_that_no_signal_shows(tools, recordings, tmp_path):
    """On 35 minutes with hills; it weighs about 32 t, on the scale of an assumed efficiency of the engine.

    The mean is 35.8 t; it is 34.7 t where lone readings of the torque are mended, which is not done at 1 Hz.
    """
    table = tools.table.read_table(recordings / "vt_hd_trucks" / "veh002_all.csv")
    log, hidden = tmp_path / "truck.blf", tmp_path / "hidden.toml"
    hidden.write_text(tools.recordings.without((TOOLS / "vt_truck.toml").read_text(), "altitude"))
    tools.vt.write(next(rows for name, rows in tools.vt.recordings(table) if name == "1d"), log)
    settings = ("--config", hidden, "--dbc", tools.vt.DBC, "--effect", "torque_bias")
    mass = tools.recordings.roadload(RunAnswer, "estimate", log, *settings).parameters.mass_kg
    assert mass.status == "estimated"
    assert 29e3 < mass.mean < 37e3
    assert mass.q05 < 34.5e3


@pytest.fixture
def truck(tools):
    return tools.truck.draw_vehicle(np.random.default_rng(1))


@pytest.fixture
def hilly(tools):
    """Half an hour of changing speeds over hills, with a stop."""
    t = np.arange(0.0, 1800.0)
    speed = np.where(abs(t - 900) < 30, 0.0, 17 + 5 * np.sin(t / 13) + 4 * np.sin(t / 37))
    return tools.roads.road_of(np.column_stack([t, speed, 0.02 * np.sin(t / 60)]))


def test_roads_have_no_corners_and_stops_stay_stops(tools, hilly):
    step = tools.roads.STEP
    assert np.diff(hilly.v).min() > -1.01 * tools.roads.BRAKING * step
    launch = slice(round(925 / step), round(935 / step))  # the table jumps there from rest to 20 m/s
    assert 5 < np.diff(hilly.v[launch]).max() / step < 10
    standing = (hilly.v == 0).sum() * step
    assert 50 < standing < 59


def test_a_weak_truck_takes_longer_over_the_same_ground(tools, truck, hilly):
    weak = tools.truck.Vehicle(**{**vars(truck), "rated_power": 150e3})
    step = tools.roads.STEP
    asked, driven = hilly, tools.truck.followed(weak, hilly)
    assert len(driven.v) > len(asked.v)
    assert driven.v.sum() * step == pytest.approx(asked.v.sum() * step, rel=0.01)
    climb = [(road.v * np.maximum(road.grade, 0)).sum() * step for road in (asked, driven)]
    assert climb[1] == pytest.approx(climb[0], rel=0.03)


def drive_by_hand(tools, vehicle, road):
    """What a simulator would say of a truck that obeys the road-load equation on a road."""
    driven = tools.truck.followed(vehicle, road)
    step = tools.roads.STEP
    t = np.arange(len(driven.v)) * step
    v, a = (driven.v[1:] + driven.v[:-1]) / 2, np.diff(driven.v) / step
    C = 3.6
    inertia = vehicle.mass + vehicle.wheels * vehicle.wheel_inertia / vehicle.wheel_radius**2
    rolling = vehicle.mass * STANDARD_GRAVITY * vehicle.rolling_coefficient
    wheels = design(v, a) @ [rolling, C, inertia]
    power = np.maximum(wheels, 0.0) / vehicle.driveline_efficiency + vehicle.auxiliary_power
    altitude = np.concatenate([[0.0], np.cumsum(v * driven.grade[1:] * step)])
    braking = np.append(wheels < -500, False)
    return tools.truck.Drive(
        t=t,
        v=driven.v,
        grade=driven.grade,
        altitude=altitude,
        t_power=t[1:] - step / 2,
        power=power,
        braking=braking,
        C=C,
    )


@pytest.mark.slow
def test_the_bus_of_the_second_world_tells_the_truth(tools, truck, hilly, tmp_path):
    truck = tools.truck.Vehicle(**{**vars(truck), "auxiliary_power": 0.0})
    drive = drive_by_hand(tools, truck, hilly)
    signals = tools.bus.signals_of(drive, np.random.default_rng(2), False, 0.01, tools.bus.FINE)
    write_log(frames_of(signals), tmp_path / "drive.blf")
    final = estimate_logs([tmp_path / "drive.blf"], config.Config(), lambda share: None).final
    seen = tools.second.truth_of(truck, drive)["at_crank"]
    assert final.mass.mean == pytest.approx(seen["mass_kg"], abs=4 * final.mass.sd)
    assert final.mass.sd < 0.02 * seen["mass_kg"]
    assert final.A.mean == pytest.approx(seen["A_N"], abs=4 * final.A.sd)
    assert final.C.mean == pytest.approx(seen["C_N_s2_m2"], abs=4 * final.C.sd)


def test_withholding_grade_changes_nothing_else(tools, truck, hilly):
    drive = drive_by_hand(tools, truck, hilly)
    shown, withheld = (
        tools.bus.signals_of(drive, np.random.default_rng(3), grade, 0.01, tools.bus.PERCENT) for grade in (True, False)
    )
    assert set(shown) - set(withheld) == {Role.GRADE, Role.ALTITUDE}
    for role, series in withheld.items():
        np.testing.assert_array_equal(series.value, shown[role].value)
    assert Role.TORQUE_FRACTION_FINE not in shown


def test_torque_that_a_bus_cannot_say_is_an_error(tools, truck, hilly):
    drive = drive_by_hand(tools, tools.truck.Vehicle(**{**vars(truck), "auxiliary_power": 600e3}), hilly)
    with pytest.raises(RoadloadError, match="of its reference torque"):
        tools.bus.signals_of(drive, np.random.default_rng(4), False, 0.01, tools.bus.FINE)


def test_fastsim_obeys_the_truth_that_is_written(tools, truck, hilly):
    pytest.importorskip("fastsim", reason="fastsim has an environment of its own: tools/check_fastsim.txt")
    drive = tools.truck.simulate(truck, tools.truck.followed(truck, hilly))
    seen = tools.second.truth_of(truck, drive)["at_crank"]
    v, a = (drive.v[1:] + drive.v[:-1]) / 2, np.diff(drive.v) / tools.roads.STEP
    climb = truck.mass / truck.driveline_efficiency * STANDARD_GRAVITY * drive.grade[1:] * v
    power = design(v, a) @ [seen["A_N"], seen["C_N_s2_m2"], seen["mass_kg"]] + climb
    pulling = power > 1e3
    np.testing.assert_allclose(drive.power[pulling], power[pulling] + truck.auxiliary_power, atol=500.0)


@pytest.mark.skipif(find_spec("fastsim") is not None, reason="fastsim is installed")
def test_without_fastsim_the_second_world_says_what_to_install(tools, truck, hilly):
    with pytest.raises(RoadloadError, match=r"pip install -r tools/check_fastsim.txt"):
        tools.truck.simulate(truck, hilly)


def answer(*names, verdict="effect", base=40.0, final=10.0, equivalent=()):
    """What `roadload diagnose` says; powers in kW."""
    closed = GapClosed(0.9, 0.85, 0.95)
    effects = [finding(name, 0.99, equivalent=equivalent, gap_closed=closed, rms_after=1e3 * final) for name in names]
    return of_diagnosis(
        Diagnosis(
            verdict=Verdict(verdict),
            effects=tuple(effects),
            rms_base=1e3 * base,
            rms_final=1e3 * final,
            noise_floor=5e3,
        )
    )


def test_share_reached_is_of_the_mean_square(tools):
    said = answer("grade")
    assert tools.recordings.share_removed(said, 40.0) == 0.0
    assert tools.recordings.share_removed(said, 20.0) == 0.75
    assert tools.recordings.share_removed(said, None) is None


def part(cause, share, reached=None):
    return Part(cause=cause, share=share, q05=None, q95=None, rms_kW=None, reached_kW=reached, expected_kW=None)


def test_a_promise_is_the_share_of_all_that_is_named_in_what_the_configuration_leaves(tools):
    parts = (
        part("road", 0.5, 30.0),
        part("brake_use", 0.22, 30.0),
        part("torque_bias", 0.2, 36.0),
        part("warm_up", 0.08),
    )
    hidden = replace(answer("grade", "brake_use", final=40.0), budget=parts)  # torque_bias is given
    assert tools.recordings.share_promised(hidden) == pytest.approx(0.9)
    assert tools.recordings.rms_promised(hidden) == pytest.approx(40.0 * 0.1**0.5)
    level = replace(answer(verdict="no gap", final=40.0), budget=(part("warm_up", 0.3), part("sensor noise", 0.7)))
    assert tools.recordings.rms_promised(level) == 40.0
    assert tools.recordings.share_promised(answer(verdict="cannot tell")) is None


@pytest.mark.parametrize(
    ("grade", "said", "right", "invented"),
    [
        ("withheld", answer("grade"), "yes", "-"),
        ("withheld", answer("headwind"), "NO", "headwind"),
        ("withheld", answer("headwind", equivalent=["grade"]), "yes", "-"),  # it says itself that it cannot tell
        ("given", answer("torque_bias", equivalent=["auxiliary_load"]), "yes", "-"),
        ("given", answer("torque_bias"), "NO", "torque_bias"),
        ("withheld", answer(verdict="no gap"), "NO", "-"),
        ("withheld", answer("grade", "load_loss"), "NO", "load_loss"),
        ("shown", answer(verdict="no gap"), "yes", "-"),
        ("shown", answer(verdict="cannot tell"), "yes", "-"),
        ("shown", answer("auxiliary_cycling"), "NO", "auxiliary_cycling"),
    ],
)
def test_the_second_world_is_judged(tools, truck, hilly, grade, said, right, invented):
    truth = tools.second.truth_of(truck, drive_by_hand(tools, truck, hilly))
    row = tools.second.judge(truth, grade, said)
    assert (row["as it should"], row["invented"]) == (right, invented)


def test_on_a_flat_road_grade_is_an_invention(tools, truck):
    flat = drive_by_hand(tools, truck, tools.roads.Road(np.full(600, 20.0), np.zeros(600)))
    row = tools.second.judge(tools.second.truth_of(truck, flat), "withheld", answer("grade"))
    assert row["invented"] == "grade"


def test_roles_are_withheld_by_configuration(tools, tmp_path):
    text = (TOOLS.parent / "dbc" / "bmw_i3.toml").read_text()
    (tmp_path / "x.toml").write_text(tools.recordings.without(text, "longitudinal_acceleration", "altitude"))
    settings = config.load(tmp_path / "x.toml")
    assert {"speed", "engine_torque", "engine_speed"} < set(settings.signals)
    assert not {"longitudinal_acceleration", "altitude"} & set(settings.signals)
    assert settings.prior == config.load(TOOLS.parent / "dbc" / "bmw_i3.toml").prior


def test_promised_and_reached_stand_side_by_side(tools, tmp_path, monkeypatch):
    folder = tmp_path / "bmw_i3"
    folder.mkdir()
    (folder / "TripA02.blf").touch()

    def roadload(kind, command, log, *arguments):
        settings = config.load(Path(arguments[1]))
        if Role.LONGITUDINAL_ACCELERATION in settings.signals:
            return replace(answer("grade", final=12.0), budget=(part("road", 0.96, 12.0),))
        if Role.ALTITUDE in settings.signals:
            return answer("headwind", final=38.0)
        return replace(answer("grade", final=38.0), budget=(part("road", 0.75, 38.0), part("sensor noise", 0.25)))

    monkeypatch.setattr(tools.recordings, "roadload", roadload)
    (row,) = tools.recordings.bmw(tmp_path, tmp_path, [])
    assert row == {
        "trip": "TripA02",
        "named, withheld": "grade (99 %)",
        "kW before": "40.00",
        "kW promised": "20.00",
        "promised": "75 %",
        "reached": "91 %",
        "named, accelerometer": "grade (99 %)",
        "kW reached": "12.00",
        "kW beside": "8.00",
        "named, GPS elevation": "headwind (99 %)",
        "kW elevation": "38.00",
    }
    with pytest.raises(RoadloadError, match="no such trip; there are TripA02"):
        list(tools.recordings.bmw(tmp_path, tmp_path, ["TripZ99"]))


MOTOR_CAR = """VERSION ""
NS_ :
BS_:
BU_:
BO_ 256 MOTION: 8 CAR
 SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|655] "km/h" Vector__XXX
BO_ 257 MOTOR: 8 CAR
 SG_ MotorTorque : 0|16@1- (0.1,0) [-3000|3000] "N.m" Vector__XXX
 SG_ MotorSpeed : 16|16@1+ (1,0) [0|65535] "rpm" Vector__XXX
"""
MOTOR_BINDING = """[bus]
dbc = ["motor.dbc"]
[signals]
speed = "MOTION.VehicleSpeed"
engine_torque = "MOTOR.MotorTorque"
engine_speed = "MOTOR.MotorSpeed"
[prior]
mass_kg = [500, 5000]
"""


@pytest.fixture
def original(tools):
    """Half an hour of a car, and the spectrum of noise that is correlated over seconds."""
    t = np.arange(0.0, 1800.0, 0.1)
    v = 14 + 6 * np.sin(t / 11) + 4 * np.sin(t / 29)
    a = 6 / 11 * np.cos(t / 11) + 4 / 29 * np.cos(t / 29)
    frequency = np.linspace(0.0, 5.0, 2049)
    spectrum = 4e6 / (1 + (frequency / 0.05) ** 2)
    truth = np.array([200.0, 0.4, 1600.0])
    return tools.surrogates.Original(
        speed=v, motor=27.65 * v, power=design(v, a) @ truth, frequency=frequency, spectrum=spectrum
    )


def test_a_surrogate_has_the_spectrum_of_the_residual(tools, original):
    rng = np.random.default_rng(5)
    drawn = np.array([tools.surrogates.surrogate(original, rng) for _ in range(40)])
    assert drawn.std() == pytest.approx(original.noise, rel=0.05)
    power = (np.abs(np.fft.rfft(drawn)) ** 2).mean(axis=0) * 2 * 0.1 / drawn.shape[1]
    frequency = np.fft.rfftfreq(drawn.shape[1], 0.1)
    for low, high in ((0.01, 0.03), (0.1, 0.2), (1.0, 2.0)):
        band, same = (frequency > low) & (frequency < high), (original.frequency > low) & (original.frequency < high)
        assert power[band].mean() == pytest.approx(original.spectrum[same].mean(), rel=0.15)


def test_errors_of_an_accelerometer_are_not_in_the_noise_beside_the_road(tools):
    rng, n, (A, C, m) = np.random.default_rng(7), 1500, (250.0, 0.4, 1600.0)
    slope, error = (gaussian_filter1d(rng.standard_normal(n), memory) for memory in (30.0, 10.0))
    slope, error, noise = 0.01 * slope / slope.std(), 0.005 * error / error.std(), rng.normal(0.0, 30.0, n)
    speed, pull = np.full(n + 1, 15.0), np.zeros(n)
    for k in range(n):
        pull[k] = A + m * (0.3 * (16 + 6 * np.sin(k / 21) - speed[k]) + 0.4 * np.sin(k / 7))
        speed[k + 1] = speed[k] + (pull[k] - A - C * speed[k] ** 2) / m - STANDARD_GRAVITY * slope[k]
    v, a = 0.5 * (speed[1:] + speed[:-1]), np.diff(speed)
    measured = made_strides(speed + rng.normal(0.0, 0.02, n + 1), pull + noise, {})
    strides = dataclasses.replace(measured, gravity=STANDARD_GRAVITY * (slope + error))
    found = road_fit.fit(strides, rng)
    drawn = tools.surrogates.drawn_slope(strides, found, rng)

    def slow(slopes, A, C, m):
        beside = pull + noise - A - C * v**2 - m * (a + STANDARD_GRAVITY * slopes)
        return gaussian_filter1d(beside, 10.0).std()

    assert slow(slope + error, A, C, m) > 60  # N, for 5 without any error
    assert slow(drawn, *found.theta[:3]) < 20


@pytest.mark.slow
def test_a_surrogate_drive_obeys_the_road_load(tools, original, tmp_path):
    (tmp_path / "motor.dbc").write_text(MOTOR_CAR)
    # The residual that was drawn is one of the power, beside a speed without any noise: as the paper sees it.
    (tmp_path / "motor.toml").write_text(MOTOR_BINDING + '[sampler]\nlikelihood = "paper"\n')
    log = tmp_path / "drive.blf"
    tools.surrogates.write_surrogate(original, tmp_path / "motor.dbc", log, np.random.default_rng(6))
    final = estimate_logs([log], config.load(tmp_path / "motor.toml"), lambda share: None).final
    assert final.mass.mean == pytest.approx(1600.0, abs=4 * final.mass.sd)
    assert final.mass.sd < 40
    assert final.A.mean == pytest.approx(200.0, abs=4 * final.A.sd)


def test_what_a_drive_promises_is_tried_on_another(tools, tmp_path, monkeypatch):
    asked = []

    def roadload(kind, command, *arguments):
        asked.append((command, *map(str, arguments)))
        if command == "simulate":
            truth = Truth(mass_kg=2e4, A_N=1500.0, C_N_s2_m2=3.5)
            return SimulationAnswer(log="", frames=0, duration_s=0.0, truth=truth, effects=(), also_acting_kW={})
        extended = "--effect" in arguments
        return answer(verdict="no gap", base=13.0, final=13.0) if extended else answer("grade", "mass_step")

    monkeypatch.setattr(tools.recordings, "roadload", roadload)
    monkeypatch.setattr(tools.pair, "roadload", roadload)
    pair = tools.pair.simulate_pair("grade", 30, 7, tmp_path)
    row = tools.pair.row("grade", pair)
    assert asked[1][-8:] == ("--mass", "20000.0", "--A", "1500.0", "--C", "3.5", "--seed", "8")
    assert asked[-2] == ("diagnose", str(pair.second), "--effect", "grade")  # what has times cannot be configured
    assert row["promised"] == "90 %"
    assert row["reached on drive 2"] == f"{100 * (1 - (13**2 - 25) / (40**2 - 25)):.0f} %"
    assert (row["kW before"], row["kW after"], row["named beside it on drive 2"]) == ("40.00", "13.00", "no gap")


def test_without_recordings_there_is_one_line(tools, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROADLOAD_DATA", str(tmp_path / "nowhere"))
    assert tools.recordings.main(["--json"]) == 2
    assert tools.second.main([str(tmp_path / "out")]) == 2
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 2
    assert all("set ROADLOAD_DATA" in line for line in complaints)


@pytest.mark.slow
def test_a_command_that_fails_says_why(tools, tmp_path):
    with pytest.raises(RoadloadError, match=r"none\.blf"):
        tools.recordings.roadload(RunAnswer, "estimate", tmp_path / "none.blf")
