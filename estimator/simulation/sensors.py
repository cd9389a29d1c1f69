"""Measurements of a drive by the truck's control units: each signal at its own rate, delayed, noisy and quantised.

The engine sends indicated torque, ``T_indicated = T_net + T_friction``, in percent of the reference torque, as
SPN 513 and 4154 do. Nominal friction is sent separately and at a lower rate, as by SPN 514. Resolutions are those of
J1939.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from estimator.preparation.recursion import low_passed
from estimator.signals import Floats, Mask, Role, Series, Signals
from estimator.simulation.moment import STEP
from estimator.simulation.noise import correlated, smooth
from estimator.simulation.truth import ORIGIN, Truth
from estimator.units import EARTH_RADIUS, STANDARD_GRAVITY

SPEED_RESOLUTION = 1 / 256 / 3.6  # m/s
ENGINE_SPEED_RESOLUTION = 0.125 * 2 * pi / 60  # rad/s
PERCENT = 0.01
PEDAL_RESOLUTION = 0.004  # of full travel
FULL_BRAKING = 6.0  # m/s^2 at full travel of the brake pedal
HEADING_NOISE = 0.01  # rad
POSITION_NOISE = 2.0  # m, to the north and to the east
POSITION_RESOLUTION = 1e-7 * pi / 180  # rad
YAW_NOISE = 0.002  # rad/s
ACCELERATION_NOISE = 0.03  # m/s^2
DROPOUT = 1.0, 8.0  # s, shortest and longest
TORQUE_PERIOD = 0.02  # s, engine torque and speed

OPTIONAL = (
    Role.ALTITUDE,
    Role.GRADE,
    Role.HEADING,
    Role.GPS_SPEED,
    Role.LATITUDE,
    Role.LONGITUDE,
    Role.AMBIENT_TEMPERATURE,
    Role.AIR_PRESSURE,
    Role.COOLANT_TEMPERATURE,
    Role.FAN_SPEED,
    Role.YAW_RATE,
    Role.LATERAL_ACCELERATION,
    Role.LONGITUDINAL_ACCELERATION,
    Role.RETARDER_FRACTION,
    Role.GEAR,
)  # signals that a bus may lack: speed and power need none of them


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """Errors of the truck's sensors.

    Parameters
    ----------
    speed_noise
        Standard deviation of the white noise on wheel speeds, before quantisation [m/s].
    torque_noise, torque_correlation
        Standard deviation, as a share of the reference torque [1], and correlation time [s] of the error of the
        engine's torque model.
    torque_white_noise
        Standard deviation of white noise on torque, as a share of the reference torque [1].
    torque_resolution
        Share of the reference torque per bit: 0.00125 with SPN 4154, 0.01 without [1].
    torque_lag
        Delay of torque and engine speed relative to vehicle speed [s].
    jitter
        Standard deviation of sending times [s].
    grade_noise, grade_offset
        Standard deviation of the slow error of the grade, and its offset, rise over run [1].
    grade_white_noise
        Standard deviation of white noise on the grade [1].
    body_pitch
        Pitch of the body, which holds the sensors of grade and acceleration, per acceleration of the truck
        [rad/(m/s^2)]; 0.003 is usual for a truck.
    accelerometer_offset
        Offset of the longitudinal acceleration [m/s^2].
    altitude_noise
        Standard deviation of an error of the altitude that changes over half a minute [m].
    altitude_white_noise
        Standard deviation of white noise on the altitude [m].
    altitude_wander, altitude_wander_time
        Standard deviation [m] and time [s] of a further error of the altitude: weather and openings of windows for a
        barometer, the constellation of satellites for a GPS receiver.
    altitude_smoothing
        Time constant by which a GPS receiver smooths the altitude [s].
    dropouts
        Share of the time [1] in which a message is lost, for seconds at a time.
    without
        Signals of ``OPTIONAL`` that are not on the bus.
    """

    speed_noise: float = 0.01
    torque_noise: float = 0.01
    torque_correlation: float = 0.5
    torque_white_noise: float = 0.002
    torque_resolution: float = 0.00125
    torque_lag: float = 0.03
    jitter: float = 0.0005
    grade_noise: float = 0.0
    grade_offset: float = 0.0
    grade_white_noise: float = 0.0
    body_pitch: float = 0.0
    accelerometer_offset: float = 0.0
    altitude_noise: float = 1.0
    altitude_white_noise: float = 0.0
    altitude_wander: float = 0.0
    altitude_wander_time: float = 600.0
    altitude_smoothing: float = 0.0
    dropouts: float = 0.0
    without: frozenset[Role] = field(default_factory=frozenset)


def measure(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Signals:
    """Signals of a drive, as sent by the control units; roles of one message share their times."""
    control_units = (
        _engine,
        _vehicle_speed,
        _transmission,
        _brakes,
        _surroundings,
        _stability,
        _accessories,
        _position,
    )
    signals = {
        role: series
        for control_unit in control_units
        for role, series in control_unit(truth, sensors, rng)
        if role not in sensors.without
    }
    return _with_dropouts(signals, sensors.dropouts, rng) if sensors.dropouts > 0.0 else signals


def _engine(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    truck, reading = truth.truck, truth.reading
    reference = truck.reference_torque
    resolution = max(sensors.torque_resolution, reading.torque_step / reference)

    t = _times(truth, TORQUE_PERIOD, sensors, rng)
    seen = t - sensors.torque_lag
    speed = np.interp(seen, truth.t, reading.engine_speed)
    indicated = np.interp(seen, truth.t, reading.torque + truck.friction_torque(reading.engine_speed)) / reference
    indicated += correlated(len(t), sensors.torque_noise, sensors.torque_correlation / TORQUE_PERIOD, rng)
    indicated += rng.normal(0.0, sensors.torque_white_noise, len(t))
    indicated = np.clip(_quantise(indicated, resolution), -1.25, 1.25)
    yield Role.ENGINE_SPEED, Series(t, _quantise(speed, ENGINE_SPEED_RESOLUTION))
    if resolution < 0.99 * PERCENT:
        whole = np.floor(indicated / PERCENT + 1e-6) * PERCENT
        yield Role.TORQUE_FRACTION, Series(t, whole)
        yield Role.TORQUE_FRACTION_FINE, Series(t, _quantise(indicated - whole, resolution))
    else:
        yield Role.TORQUE_FRACTION, Series(t, indicated)

    t = _times(truth, 0.25, sensors, rng)
    friction = truck.friction_torque(np.interp(t - sensors.torque_lag, truth.t, reading.engine_speed)) / reference
    yield Role.FRICTION_FRACTION, Series(t, _quantise(friction, PERCENT))
    t = _times(truth, 5.0, sensors, rng)
    yield Role.REFERENCE_TORQUE, Series(t, np.full(len(t), reference))


def _vehicle_speed(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 0.1, sensors, rng)
    yield Role.SPEED, Series(t, _wheel_speed(truth, t, sensors, rng))
    yield Role.BRAKE_SWITCH, _state(truth, t, truth.braking)
    yield Role.CLUTCH_SWITCH, _state(truth, t, ~truth.engaged)
    yield Role.PARK_BRAKE, _state(truth, t, truth.parked)
    t = _times(truth, 0.1, sensors, rng)
    yield Role.WHEEL_SPEEDS, Series(t, _wheel_speed(truth, t, sensors, rng))


def _transmission(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 0.02, sensors, rng)
    yield Role.DRIVELINE_ENGAGED, _state(truth, t, truth.engaged)
    yield Role.SHIFT_IN_PROCESS, _state(truth, t, truth.shifting)
    t = _times(truth, 0.1, sensors, rng)
    yield Role.GEAR, _state(truth, t, truth.gear)


def _brakes(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 0.1, sensors, rng)
    pedal = np.interp(t, truth.t, truth.brake) / (FULL_BRAKING * truth.truck.mass)
    pressed = _state(truth, t, truth.braking).value > 0.0
    yield Role.BRAKE_PEDAL, Series(t, np.where(pressed, np.clip(_quantise(pedal, PEDAL_RESOLUTION), 0.0, 1.0), 0.0))
    t = _times(truth, 0.1, sensors, rng)
    grade = np.interp(t, truth.t, truth.grade + sensors.body_pitch * truth.a) + sensors.grade_offset
    if sensors.grade_noise > 0.0:
        grade += smooth(len(t), sensors.grade_noise, 20.0 / 0.1, rng)
    if sensors.grade_white_noise > 0.0:
        grade += rng.normal(0.0, sensors.grade_white_noise, len(t))
    yield Role.GRADE, Series(t, grade)
    if truth.retarder.any():
        strength = np.interp(t, truth.t, truth.retarder) / truth.retarder.max()
        yield Role.RETARDER_FRACTION, Series(t, -_quantise(strength, PERCENT))


def _surroundings(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 1.0, sensors, rng)
    air = np.interp(t, truth.t, truth.ambient_temperature) + smooth(len(t), 0.5, 600.0, rng)
    yield Role.AMBIENT_TEMPERATURE, Series(t, _quantise(air, 1 / 32, 273.15))
    yield Role.AIR_PRESSURE, Series(t, _quantise(np.interp(t, truth.t, truth.pressure), 500.0))
    t = _times(truth, 1.0, sensors, rng)
    coolant = np.interp(t, truth.t, truth.coolant_temperature) + smooth(len(t), 0.5, 120.0, rng)
    yield Role.COOLANT_TEMPERATURE, Series(t, _quantise(coolant, 1.0, 273.15))
    t = _times(truth, 1.0, sensors, rng)
    satellites = np.interp(t, truth.t, truth.v) + rng.normal(0.0, 0.05, len(t))
    altitude = _altitude(truth, t, sensors, rng)
    heading = np.interp(t, truth.t, truth.heading) + rng.normal(0.0, HEADING_NOISE, len(t))
    yield Role.ALTITUDE, Series(t, _quantise(altitude, 0.125))
    yield Role.GPS_SPEED, Series(t, _quantise(np.maximum(satellites, 0.0), SPEED_RESOLUTION))
    yield Role.HEADING, Series(t, _quantise(heading % (2 * pi), pi / 180 / 128) % (2 * pi))


def _altitude(truth: Truth, t: Floats, sensors: Sensors, rng: np.random.Generator) -> Floats:
    """Altitude [m] (n,) with its errors, at times (n,) [s] with a spacing of one second."""
    altitude: Floats = np.interp(t, truth.t, truth.altitude)
    if sensors.altitude_smoothing > 0.0:
        altitude = low_passed(altitude, altitude[0], 1.0, sensors.altitude_smoothing)
    altitude = altitude + smooth(len(t), sensors.altitude_noise, 30.0, rng)
    if sensors.altitude_wander > 0.0:
        altitude += smooth(len(t), sensors.altitude_wander, sensors.altitude_wander_time, rng)
    if sensors.altitude_white_noise > 0.0:
        altitude += rng.normal(0.0, sensors.altitude_white_noise, len(t))
    return altitude


def _stability(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 0.1, sensors, rng)
    rise = truth.grade + sensors.body_pitch * truth.a
    felt = truth.a + STANDARD_GRAVITY * rise / np.hypot(1.0, rise) + sensors.accelerometer_offset
    for role, true, noise in (
        (Role.YAW_RATE, truth.yaw_rate, YAW_NOISE),
        (Role.LATERAL_ACCELERATION, truth.lateral_acceleration, ACCELERATION_NOISE),
        (Role.LONGITUDINAL_ACCELERATION, felt, ACCELERATION_NOISE),
    ):
        yield role, Series(t, np.interp(t, truth.t, true) + rng.normal(0.0, noise, len(t)))


def _accessories(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    t = _times(truth, 1.0, sensors, rng)
    yield Role.FAN_SPEED, Series(t, _quantise(np.interp(t, truth.t, truth.fan_speed), ENGINE_SPEED_RESOLUTION))


def _position(truth: Truth, sensors: Sensors, rng: np.random.Generator) -> Iterator[tuple[Role, Series]]:
    generator = rng.spawn(1)[0]  # a generator of its own: dropouts of other messages do not depend on the position
    t = _times(truth, 1.0, sensors, generator)
    scales = 1 / EARTH_RADIUS, 1 / (EARTH_RADIUS * cos(ORIGIN[0]))  # rad/m
    for role, true, scale in zip((Role.LATITUDE, Role.LONGITUDE), truth.position, scales, strict=True):
        measured = np.interp(t, truth.t, true) + generator.normal(0.0, POSITION_NOISE * scale, len(t))
        yield role, Series(t, _quantise(measured, POSITION_RESOLUTION))


def _with_dropouts(signals: Signals, share: float, rng: np.random.Generator) -> Signals:
    """Drop messages for a few seconds at a time; signals of one message share their times, and are lost together."""
    kept: dict[int, Mask] = {}
    for series in signals.values():
        if id(series.t) not in kept:
            kept[id(series.t)] = _received(series.t, share, rng)
    return {
        role: Series(series.t[kept[id(series.t)]], series.value[kept[id(series.t)]]) for role, series in signals.items()
    }


def _received(t: Floats, share: float, rng: np.random.Generator) -> Mask:
    count = rng.poisson(share * (t[-1] - t[0]) / np.mean(DROPOUT))
    received = np.ones(len(t), bool)
    for start, length in zip(rng.uniform(t[0], t[-1], count), rng.uniform(*DROPOUT, count), strict=True):
        received &= (t < start) | (t > start + length)
    received[0] = True
    return received


def _times(truth: Truth, period: float, sensors: Sensors, rng: np.random.Generator) -> Floats:
    """Draw the sending times [s] of one message: its period, a random phase, and jitter."""
    end = truth.t[-1]
    nominal = np.arange(rng.uniform(0.0, period), end, period)
    late = np.clip(rng.normal(0.0, 1.0, len(nominal)) * sensors.jitter, -0.4 * period, 0.4 * period)
    return np.clip(nominal + late, 0.0, end)


def _wheel_speed(truth: Truth, t: Floats, sensors: Sensors, rng: np.random.Generator) -> Floats:
    v = np.interp(t, truth.t, truth.reading.v)
    noisy = v + rng.normal(0.0, 1.0, len(t)) * sensors.speed_noise
    return _quantise(np.where(v > 0.0, np.maximum(noisy, 0.0), 0.0), SPEED_RESOLUTION)


def _state(truth: Truth, t: Floats, states: NDArray[np.generic]) -> Series:
    """Switch or gear at the last step before each time."""
    return Series(t, states[(t / STEP).astype(int)].astype(np.float64))


def _quantise(value: Floats, resolution: float, origin: float = 0.0) -> Floats:
    counts: Floats = np.round((value - origin) / resolution)
    return counts * resolution + origin
