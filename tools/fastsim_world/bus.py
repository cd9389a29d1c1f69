"""J1939 traffic of a drive: gears, sending rates, resolution and sensor noise, which fastsim does not have."""

from math import exp, sqrt

import numpy as np
from scipy.signal import lfilter

from estimator.errors import RoadloadError
from estimator.signals import Floats, Role, Series, Signals
from fastsim_world.roads import STEP
from fastsim_world.truck import Drive

RPM = 2 * np.pi / 60  # rad/s
IDLE, UPSHIFT, DOWNSHIFT = 600 * RPM, 1500 * RPM, 1050 * RPM  # rad/s
GEARING = 5.0 * 1.28 ** np.arange(11, -1, -1)  # rad/m, engine rotation per distance, lowest gear first
REFERENCE_TORQUE = 3200.0  # N.m
MAX_TORQUE_SHARE = 1.25  # of the reference torque, SPN 513
PERCENT, FINE = 0.01, 0.00125  # of the reference torque, per bit
AIR_TEMPERATURE = 295.15  # K, fastsim's
SEA_LEVEL = 101_325.0  # Pa


def gears_of(v: Floats) -> Floats:
    """Gear (n,), 1 the lowest, of a gearbox that shifts by engine speed."""
    gear, gears = 0, []
    for speed in v.tolist():
        while gear < len(GEARING) - 1 and speed * GEARING[gear] > UPSHIFT:
            gear += 1
        while gear > 0 and speed * GEARING[gear] < DOWNSHIFT:
            gear -= 1
        gears.append(gear + 1)
    return np.array(gears, dtype=np.float64)


def signals_of(
    drive: Drive, rng: np.random.Generator, grade: bool, speed_noise: float, torque_resolution: float
) -> Signals:
    """Traffic of a drive; altitude and pitch only if ``grade``.

    ``speed_noise`` [m/s] is white, the engine's torque is off by slow noise of 1 % of the reference torque, and
    rounded to ``torque_resolution`` of it [1].

    Raises
    ------
    RoadloadError
        The engine's torque is above the range of its signal.
    """
    span = drive.t[-1]
    slow, fast = np.arange(0.0, span, 0.1), np.arange(0.0, span, 0.02)
    v = np.interp(slow, drive.t, drive.v)
    gear = gears_of(v)
    seen = np.where(v > 0, np.maximum(v + rng.normal(0.0, speed_noise, len(v)), 0.0), 0.0)
    held = np.minimum((fast / 0.1).astype(int), len(slow) - 1)
    engine = np.maximum(np.interp(fast, slow, v) * GEARING[gear[held].astype(int) - 1], IDLE)
    friction = _friction(engine)
    keep = exp(-0.02 / 0.5)  # the torque model's error, correlated over 0.5 s
    error = lfilter([sqrt(1 - keep**2)], [1, -keep], rng.normal(0.0, 0.01, len(fast)))
    torque = np.interp(fast, drive.t_power, drive.power) / engine / REFERENCE_TORQUE + friction + error
    torque = np.maximum(np.round(torque / torque_resolution) * torque_resolution, 0.0)
    if torque.max() > MAX_TORQUE_SHARE:
        raise RoadloadError(f"the engine gives {100 * torque.max():.0f} % of its reference torque; a bus says 125 %")
    whole = torque if torque_resolution >= PERCENT else np.floor(torque / PERCENT + 1e-6) * PERCENT
    late, second, rare = np.arange(0.0, span, 0.25), np.arange(0.0, span, 1.0), np.arange(0.0, span, 5.0)
    nearest = np.minimum((slow / STEP).round().astype(int), len(drive.t) - 1)
    altitude = np.interp(second, drive.t, drive.altitude)
    signals = {
        Role.SPEED: Series(slow, seen),
        Role.BRAKE_SWITCH: Series(slow, drive.braking[nearest].astype(np.float64)),
        Role.GEAR: Series(slow, gear),
        Role.TORQUE_FRACTION: Series(fast, whole),
        Role.ENGINE_SPEED: Series(fast, engine),
        Role.FRICTION_FRACTION: Series(late, np.interp(late, fast, friction)),
        Role.REFERENCE_TORQUE: Series(rare, np.full(len(rare), REFERENCE_TORQUE)),
        Role.AMBIENT_TEMPERATURE: Series(second, np.full(len(second), AIR_TEMPERATURE)),
        # fastsim's air density does not change with altitude, so the pressure is constant.
        Role.AIR_PRESSURE: Series(second, np.full(len(second), SEA_LEVEL)),
    }
    if torque_resolution < PERCENT:
        signals[Role.TORQUE_FRACTION_FINE] = Series(fast, torque - whole)
    if grade:
        signals[Role.GRADE] = Series(slow, np.interp(slow, drive.t, drive.grade))
        signals[Role.ALTITUDE] = Series(second, altitude)
    return signals


def _friction(engine_speed: Floats) -> Floats:
    """Friction of the engine as a share of the reference torque [1] at an engine speed [rad/s]."""
    return 0.035 + 0.04 * engine_speed / (2000 * RPM)
