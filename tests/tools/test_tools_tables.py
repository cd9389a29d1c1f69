"""Another simulator's drives and real recordings are judged as they should be."""

import csv
import dataclasses
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnoses import finding
from made_strides import made_strides
from msgspec.structs import replace
from project_paths import TOOLS
from scipy.ndimage import gaussian_filter1d

from estimator import config
from estimator.answers.diagnosis import Part, Verdict
from estimator.answers.run import RunAnswer
from estimator.answers.simulation import SimulationAnswer, Truth
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.diagnosis.result import Diagnosis, GapClosed
from estimator.errors import RoadloadError
from estimator.estimation import road_fit
from estimator.model.road_load import design
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.signals import Role
from estimator.streaming.replay import estimate_logs
from estimator.units import STANDARD_GRAVITY


@pytest.fixture
def tools():
    import check_fastsim
    import check_recordings
    import check_transfer
    import fastsim_world.bus
    import fastsim_world.roads
    import fastsim_world.truck
    import harness.drives
    import recordings.dynamometer
    import recordings.surrogates
    import recordings.truck

    return SimpleNamespace(
        vt=recordings.truck,
        rolls=recordings.dynamometer,
        surrogates=recordings.surrogates,
        recordings=check_recordings,
        second=check_fastsim,
        pair=check_transfer,
        roads=fastsim_world.roads,
        truck=fastsim_world.truck,
        bus=fastsim_world.bus,
        drives=harness.drives,
    )


def once(settings):
    """The settings with one conclusion, at the end of the log."""
    return config.replace(settings, gate=replace(settings.gate, interval_s=7200.0))


@pytest.mark.slow
def test_a_table_at_one_hertz_is_enough_for_the_estimator(tools, tmp_path):
    t = np.arange(3600.0)
    waves = [(5.0, 97.0), (3.0, 41.0), (2.0, 211.0)]
    v = 16 + sum(size * np.sin(2 * np.pi * t / period) for size, period in waves)
    a = sum(size * 2 * np.pi / period * np.cos(2 * np.pi * t / period) for size, period in waves)
    truth = np.array([1500.0, 3.5, 22_000.0])
    noise = np.random.default_rng(1).normal(0.0, 3e3, len(t))
    power = np.maximum(design(v, a) @ truth + noise, 0.0) / 1e3
    columns = {"t": t, "vel (mph)": v / 0.44704, "fuel (g/s)": power / 17.976, "engine (rpm)": 0 * t + 1200}
    log = tmp_path / "truck.csv"
    tools.vt.write(columns | {"elevation (m)": 0 * t}, log)
    text = tools.recordings.without(tools.vt.CONFIG.read_text(), "altitude")
    (tmp_path / "truck.toml").write_text(text)
    final = estimate_logs([log], once(config.load(tmp_path / "truck.toml")), lambda share: None).final
    assert final.mass.mean == pytest.approx(truth[2], rel=0.02)
    assert final.A.mean == pytest.approx(truth[0], rel=0.1)
    assert final.C.mean == pytest.approx(truth[1], rel=0.1)


def truck_table(phase, speed, elevation):
    columns = {"vel (mph)": speed, "fuel (g/s)": 0 * speed + 5, "engine (rpm)": 0 * speed + 1200}
    return columns | {"elevation (m)": elevation, "phase_num": phase}


def test_recordings_of_a_table_are_taken_apart(tools):
    phase = np.repeat([1, 2, 1], [200, 100, 100])
    speed, elevation = np.full(400, 50.0), np.arange(400.0) / 10
    elevation[80:] += 40.0  # rows are missing here, and a few moments later again
    speed[100:] += 10.0
    found = dict(tools.vt.recordings(truck_table(phase, speed, elevation)))
    assert list(found) == ["1a", "2a", "1b"]
    assert [len(rows["t"]) for rows in found.values()] == [180, 100, 100]  # 20 rows between two jumps are no drive
    t, height = found["1a"]["t"], found["1a"]["elevation (m)"]
    assert np.flatnonzero(np.diff(t) > 1).tolist() == [79]
    assert t[80] - t[79] > 100
    assert np.allclose(height[:80], elevation[:80])
    assert np.allclose(height[80:], elevation[100:200])


def test_without_fuel_the_power_of_the_truck_is_not_known(tools, tmp_path):
    t = np.arange(100.0)
    table = truck_table(0 * t + 1, 0 * t + 50, 0 * t)
    table["fuel (g/s)"][40:60] = 0.0
    ((_, recording),) = tools.vt.recordings(table)
    tools.vt.write(recording, tmp_path / "truck.csv")
    with (tmp_path / "truck.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [i for i, row in enumerate(rows) if row["power"] == "nan"] == list(range(40, 60))
    assert {float(row["speed"]) for row in rows} == {50.0}


@pytest.mark.slow
def test_a_car_on_rolls_has_the_mass_that_the_rolls_give_it(tools, recordings, tmp_path):
    """By least squares of the measured force it has 1,642 to 1,679 kg, by how the speed is differentiated.

    A is about 0 there, which is not an estimate.
    """
    log = tmp_path / "car.csv"
    tools.rolls.write(recordings / "argonne_d3" / "61506048.txt", log)
    found = tools.recordings.roadload(RunAnswer, "estimate", log, "--config", tools.rolls.CONFIG).parameters
    assert found.mass_kg.mean == pytest.approx(1675, rel=0.01)
    assert found.mass_kg.sd < 0.01 * found.mass_kg.mean
    assert (found.A_N.status, found.A_N.mean) == ("unestimated", None)


@pytest.mark.slow
def test_a_real_truck_is_weighed_on_a_road_that_no_signal_shows(tools, recordings, tmp_path):
    """On 35 minutes with hills; it weighs about 32 t, on the scale of an assumed efficiency of the engine.

    The mean is 35.8 t; it is 34.7 t where lone readings of the torque are mended, which is not done at 1 Hz.
    """
    table = tools.vt.read(recordings / "vt_hd_trucks" / "veh002_all.csv")
    log, hidden = tmp_path / "truck.csv", tmp_path / "hidden.toml"
    hidden.write_text(tools.recordings.without(tools.vt.CONFIG.read_text(), "altitude"))
    tools.vt.write(next(rows for name, rows in tools.vt.recordings(table) if name == "1d"), log)
    settings = ("--config", hidden, "--effect", "torque_bias")
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


def at_crank(truck, drive):
    """Mass [kg], A [N] and C [N s^2/m^2] as the engine feels them, with the driveline's losses."""
    inertia = truck.mass + truck.wheels * truck.wheel_inertia / truck.wheel_radius**2
    A = truck.mass * STANDARD_GRAVITY * truck.rolling_coefficient
    return {
        name: value / truck.driveline_efficiency
        for name, value in (("mass_kg", inertia), ("A_N", A), ("C_N_s2_m2", drive.C))
    }


@pytest.mark.slow
def test_the_bus_of_the_second_world_tells_the_truth(tools, truck, hilly, tmp_path):
    truck = tools.truck.Vehicle(**{**vars(truck), "auxiliary_power": 0.0})
    drive = drive_by_hand(tools, truck, hilly)
    signals = tools.bus.signals_of(drive, np.random.default_rng(2), False, 0.01, tools.bus.FINE)
    write_log(frames_of(signals), tmp_path / "drive.blf")
    final = estimate_logs([tmp_path / "drive.blf"], once(config.Config()), lambda share: None).final
    seen = at_crank(truck, drive)
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
    pytest.importorskip("fastsim", reason="fastsim has an environment of its own: tools/fastsim_world/requirements.txt")
    drive = tools.truck.simulate(truck, tools.truck.followed(truck, hilly))
    seen = at_crank(truck, drive)
    v, a = (drive.v[1:] + drive.v[:-1]) / 2, np.diff(drive.v) / tools.roads.STEP
    climb = truck.mass / truck.driveline_efficiency * STANDARD_GRAVITY * drive.grade[1:] * v
    power = design(v, a) @ [seen["A_N"], seen["C_N_s2_m2"], seen["mass_kg"]] + climb
    pulling = power > 1e3
    np.testing.assert_allclose(drive.power[pulling], power[pulling] + truck.auxiliary_power, atol=500.0)


@pytest.mark.skipif(find_spec("fastsim") is not None, reason="fastsim is installed")
def test_without_fastsim_the_second_world_says_what_to_install(tools, truck, hilly):
    with pytest.raises(RoadloadError, match=r"pip install -r tools/fastsim_world/requirements.txt"):
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
    level = replace(answer(verdict="no gap", final=40.0), budget=(part("warm_up", 0.3), part("sensor noise", 0.7)))
    assert tools.recordings.share_promised(level) == 0.0
    assert tools.recordings.share_promised(answer(verdict="cannot tell")) is None


@pytest.mark.slow
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
    truth = tools.second.truth_of(drive_by_hand(tools, truck, hilly))
    row = tools.second.judge(truth, grade, said)
    assert (row["as it should"], row["invented"]) == (right, invented)


def test_on_a_flat_road_grade_is_an_invention(tools, truck):
    flat = drive_by_hand(tools, truck, tools.roads.Road(np.full(600, 20.0), np.zeros(600)))
    row = tools.second.judge(tools.second.truth_of(flat), "withheld", answer("grade"))
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

    monkeypatch.setattr(tools.drives, "roadload", roadload)
    (row,) = tools.recordings.bmw(tmp_path, tmp_path, [])
    assert row == {
        "trip": "TripA02",
        "named, withheld": "grade (99 %)",
        "kW before": 40.0,
        "promised [%]": pytest.approx(75.0),
        "reached [%]": pytest.approx(91.0),
        "named, accelerometer": "grade (99 %)",
        "kW reached": 12.0,
        "named, GPS elevation": "headwind (99 %)",
        "kW elevation": 38.0,
    }
    with pytest.raises(RoadloadError, match="no such trip; there are TripA02"):
        list(tools.recordings.bmw(tmp_path, tmp_path, ["TripZ99"]))


PRIOR = """
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


@pytest.mark.slow
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
    found = road_fit.fit(strides)
    drawn = tools.surrogates.drawn_slope(strides, found, rng)

    def slow(slopes, A, C, m):
        beside = pull + noise - A - C * v**2 - m * (a + STANDARD_GRAVITY * slopes)
        return gaussian_filter1d(beside, 10.0).std()

    assert slow(slope + error, A, C, m) > 60  # N, for 5 without any error
    assert slow(drawn, *found.theta[:3]) < 20


@pytest.mark.slow
def test_a_surrogate_drive_obeys_the_road_load(tools, original, tmp_path):
    # The residual that was drawn is one of the power, beside a speed without any noise: as the paper sees it.
    (tmp_path / "motor.toml").write_text(tools.surrogates.COLUMNS + PRIOR + '[sampler]\nlikelihood = "paper"\n')
    log = tmp_path / "drive.csv"
    tools.surrogates.write_surrogate(original, log, np.random.default_rng(6))
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

    monkeypatch.setattr(tools.drives, "roadload", roadload)
    monkeypatch.setattr(tools.pair, "roadload", roadload)
    pair = tools.pair.simulate_pair("grade", 30, 7, tmp_path)
    row = tools.pair.row("grade", *pair)
    assert asked[1][-8:] == ("--mass", "20000.0", "--A", "1500.0", "--C", "3.5", "--seed", "8")
    assert asked[-2] == ("diagnose", str(pair[1]), "--effect", "grade")  # what has times cannot be configured
    assert row["promised [%]"][0] == pytest.approx(90)
    assert row["reached on drive 2 [%]"] == pytest.approx(100 * (1 - (13**2 - 25) / (40**2 - 25)))
    assert (row["kW before"], row["kW after"], row["named beside it on drive 2"]) == (40.0, 13.0, "no gap")


def test_without_recordings_there_is_one_line(tools, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROADLOAD_DATA", str(tmp_path / "nowhere"))
    assert tools.recordings.CHECK.main(["--json"]) == 2
    assert tools.second.CHECK.main(["--json"]) == 2
    complaints = capsys.readouterr().err.splitlines()
    assert len(complaints) == 2
    assert all("set ROADLOAD_DATA" in line for line in complaints)


@pytest.mark.slow
def test_a_command_that_fails_says_why(tools, tmp_path):
    with pytest.raises(RoadloadError, match=r"none\.blf"):
        tools.recordings.roadload(RunAnswer, "estimate", tmp_path / "none.blf")
