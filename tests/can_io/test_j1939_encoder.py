"""Recorded drives on the bus: layouts, rates, sources, transport protocol, log files."""

import can
import numpy as np
import pytest

from estimator.can_io.binding import load_database
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.log_writer import write_log
from estimator.errors import LogError, RoadloadError
from estimator.signals import Role, Series
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.units import conversion_of

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
ENGINE, TRANSMISSION, BRAKES, NAVIGATION = 0x00, 0x03, 0x0B, 0x1C


def record_urban(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    return record(TRUCK, generate_route("urban", 5e3, rng, grade_sd=0.01), 60.0, rng)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record_urban(seed=21)


@pytest.fixture(scope="module")
def frames(recording) -> Frames:
    return frames_of(recording.signals)


def sent(frames: Frames, pgn: int, source: int) -> Frames:
    return frames[((frames.ident >> 8 & 0x3FFFF) == pgn) & ((frames.ident & 0xFF) == source)]


def test_layouts_of_the_inputs():
    """Positions, lengths, scales and offsets by SAE J1939-71."""
    database = load_database([])
    layouts = {
        "WheelBasedVehicleSpeed": (0xFEF1, 8, 16, 1 / 256, 0, "km/h"),
        "ActualEngPercentTorque": (0xF004, 16, 8, 1, -125, "%"),
        "ActualEngPercentTorqueFractional": (0xF004, 4, 4, 0.125, 0, "%"),
        "EngSpeed": (0xF004, 24, 16, 0.125, 0, "rpm"),
        "NominalFrictionPercentTorque": (0xFEDF, 0, 8, 1, -125, "%"),
        "EngReferenceTorque": (0xFEE3, 152, 16, 1, 0, "Nm"),
        "TransShiftInProcess": (0xF002, 4, 2, 1, 0, None),
        "TransCurrentGear": (0xF005, 24, 8, 1, -125, None),
        "Latitude": (0xFEF3, 0, 32, 1e-7, -210, "deg"),
        "Longitude": (0xFEF3, 32, 32, 1e-7, -210, "deg"),
    }
    found = {
        s.name: (m.frame_id >> 8 & 0x3FFFF, s.start, s.length, s.scale, s.offset, s.unit)
        for m in database.messages
        for s in m.signals
    }

    assert layouts.items() <= found.items()
    assert {m.protocol for m in database.messages} == {"j1939"}
    assert {m.frame_id & 0xFF for m in database.messages} == {0xFE}


@pytest.mark.parametrize(
    ("pgn", "source", "period", "priority"),
    [
        (0xF004, ENGINE, 0.02, 3),
        (0xFEDF, ENGINE, 0.25, 6),
        (0xFEF1, ENGINE, 0.1, 6),
        (0xFEF5, ENGINE, 1.0, 6),
        (0xFEEE, ENGINE, 1.0, 6),
        (0xF002, TRANSMISSION, 0.02, 3),
        (0xF005, TRANSMISSION, 0.1, 6),
        (0xF001, BRAKES, 0.1, 6),
        (0xFEBF, BRAKES, 0.1, 6),
        (0xFEF3, NAVIGATION, 1.0, 6),
    ],
)
def test_rates_and_sources(frames, pgn, source, period, priority):
    group = sent(frames, pgn, source)

    assert np.mean(np.diff(group.t)) == pytest.approx(period, rel=0.01)
    assert np.all(group.ident & EXTENDED)
    assert np.all(group.ident >> 26 & 7 == priority)
    assert np.all(group.length == 8)


@pytest.mark.parametrize(
    ("message", "source", "signal", "role"),
    [
        ("CCVS1", ENGINE, "WheelBasedVehicleSpeed", Role.SPEED),
        ("CCVS1", ENGINE, "BrakeSwitch", Role.BRAKE_SWITCH),
        ("CCVS1", ENGINE, "ParkingBrakeSwitch", Role.PARK_BRAKE),
        ("EEC1", ENGINE, "EngSpeed", Role.ENGINE_SPEED),
        ("EEC1", ENGINE, "ActualEngPercentTorque", Role.TORQUE_FRACTION),
        ("EEC1", ENGINE, "ActualEngPercentTorqueFractional", Role.TORQUE_FRACTION_FINE),
        ("EEC3", ENGINE, "NominalFrictionPercentTorque", Role.FRICTION_FRACTION),
        ("ETC1", TRANSMISSION, "TransShiftInProcess", Role.SHIFT_IN_PROCESS),
        ("ETC1", TRANSMISSION, "TransDrivelineEngaged", Role.DRIVELINE_ENGAGED),
        ("ETC2", TRANSMISSION, "TransCurrentGear", Role.GEAR),
        ("EBC1", BRAKES, "BrakePedalPosition", Role.BRAKE_PEDAL),
        ("AMB", ENGINE, "AmbientAirTemperature", Role.AMBIENT_TEMPERATURE),
        ("AMB", ENGINE, "BarometricPressure", Role.AIR_PRESSURE),
        ("ET1", ENGINE, "EngCoolantTemperature", Role.COOLANT_TEMPERATURE),
        ("VP", NAVIGATION, "Latitude", Role.LATITUDE),
        ("VP", NAVIGATION, "Longitude", Role.LONGITUDE),
    ],
)
def test_cantools_reads_back_what_was_measured(recording, frames, message, source, signal, role):
    layout = load_database([]).get_message_by_name(message)
    group = sent(frames, layout.frame_id >> 8 & 0x3FFFF, source)
    physical = np.array([layout.decode(row.tobytes())[signal] for row in group.data])
    conversion = conversion_of(layout.get_signal_by_name(signal).unit)
    si = physical if conversion is None else conversion.scale * physical + conversion.offset

    np.testing.assert_allclose(group.t, EPOCH + recording.signals[role].t, atol=1e-6)
    np.testing.assert_allclose(si, recording.signals[role].value, rtol=1e-9, atol=1e-9)


def test_grade_goes_out_as_pitch_angle(recording, frames):
    layout = load_database([]).get_message_by_name("SSI")
    group = sent(frames, 0xF013, BRAKES)
    pitch = np.array([layout.decode(row.tobytes())["PitchAngle"] for row in group.data])

    assert np.ptp(pitch) > 0.1
    np.testing.assert_allclose(np.tan(np.radians(pitch)), recording.signals[Role.GRADE].value, atol=2e-5)


def test_unknown_parameters_are_not_available(frames):
    speeds = sent(frames, 0xFEF1, ENGINE)

    assert np.all(speeds.data[:, 4:] == 0xFF)
    assert np.all(sent(frames, 0xF004, ENGINE).data[:, 1] == 0xFF)


def test_reference_torque_comes_by_broadcast_in_39_bytes(recording, frames):
    announced = sent(frames, 0xECFF, ENGINE)
    packets = sent(frames, 0xEBFF, ENGINE)

    assert len(announced) == len(recording.signals[Role.REFERENCE_TORQUE].t)
    assert announced.data[0].tobytes() == bytes.fromhex("20270006ffe3fe00")
    for k, t in enumerate(announced.t):
        rows = packets[6 * k : 6 * k + 6]
        np.testing.assert_allclose(rows.t - t, 0.05 * np.arange(1, 7), atol=1e-6)
        np.testing.assert_array_equal(rows.data[:, 0], np.arange(1, 7))
        payload = rows.data[:, 1:].tobytes()
        assert payload[39:] == b"\xff" * 3
        decoded = load_database([]).get_message_by_name("EC1").decode(payload[:39])
        assert decoded["EngReferenceTorque"] == TRUCK.reference_torque


def test_times_rise_and_the_same_seed_gives_the_same_bytes(frames):
    again = frames_of(record_urban(seed=21).signals)
    other = frames_of(record_urban(seed=22).signals)

    assert np.all(np.diff(frames.t) >= 0.0)
    assert frames.t.tobytes() == again.t.tobytes()
    assert frames.data.tobytes() == again.data.tobytes()
    assert frames.data.tobytes() != other.data.tobytes()


def test_values_beyond_the_range_stay_valid():
    signals = {Role.SPEED: Series(np.array([0.0, 0.1]), np.array([-1.0, 1000.0]))}
    data = frames_of(signals).data

    assert data[0, 1:3].tolist() == [0, 0]
    assert data[1, 1:3].tolist() == [0xFF, 0xFA]


def test_a_signal_not_yet_measured_is_not_available():
    signals = {
        Role.SPEED: Series(np.array([0.0, 0.1]), np.array([1.0, 1.0])),
        Role.BRAKE_SWITCH: Series(np.array([0.05]), np.array([1.0])),
    }
    switches = frames_of(signals).data[:, 3] >> 4 & 3

    assert switches.tolist() == [3, 1]


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log", ".csv", ".trc"])
def test_log_reads_back_by_python_can(frames, tmp_path, suffix):
    part = frames[:500]
    path = tmp_path / f"drive{suffix}"
    write_log(part, path)
    options = {"relative_timestamp": False} if suffix == ".asc" else {}
    with can.LogReader(path, **options) as log:
        back = Frames.from_messages(log)

    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    np.testing.assert_array_equal(back.ident, part.ident)
    np.testing.assert_array_equal(back.data, part.data)
    np.testing.assert_allclose(np.diff(back.t), np.diff(part.t), atol=2e-4)


def test_log_bytes_are_reproducible(frames, tmp_path):
    for name in ("a.blf", "b.blf"):
        write_log(frames[:2000], tmp_path / name)

    assert (tmp_path / "a.blf").read_bytes() == (tmp_path / "b.blf").read_bytes()


def test_unknown_log_format_and_missing_folder_are_told(frames, tmp_path):
    with pytest.raises(LogError, match=r"drive\.xyz"):
        write_log(frames[:10], tmp_path / "drive.xyz")
    with pytest.raises(RoadloadError, match="cannot write"):
        write_log(frames[:10], tmp_path / "nowhere" / "drive.log")
    assert not list(tmp_path.iterdir())


def test_a_value_that_is_none_is_sent_as_not_available() -> None:
    t = np.arange(3) * 0.1
    frames = frames_of({Role.SPEED: Series(t, np.array([10.0, np.nan, 10.0]))})
    speed = [bytes(m.data)[1:3] for m in frames.messages() if m.arbitration_id >> 8 & 0xFFFF == 0xFEF1]
    assert b"\xff\xff" in speed
    assert b"\x00\x00" not in speed
