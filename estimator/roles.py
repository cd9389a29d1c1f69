"""The uses of CAN signals in the estimate, their SI units, and the quantities that are derived from them."""

from collections.abc import Set
from enum import StrEnum


class Role(StrEnum):
    """The use of a CAN signal in the estimate; the value is its name in the configuration."""

    SPEED = "speed"
    WHEEL_SPEEDS = "wheel_speeds"
    ENGINE_POWER = "engine_power"
    ENGINE_TORQUE = "engine_torque"
    ENGINE_SPEED = "engine_speed"
    TORQUE_FRACTION = "torque_fraction"
    TORQUE_FRACTION_FINE = "torque_fraction_fine"
    FRICTION_FRACTION = "friction_fraction"
    PARASITIC_FRACTION = "parasitic_fraction"
    REFERENCE_TORQUE = "reference_torque"
    GEAR = "gear"
    BRAKE_SWITCH = "brake_switch"
    BRAKE_PEDAL = "brake_pedal"
    CLUTCH_SWITCH = "clutch_switch"
    SHIFT_IN_PROCESS = "shift_in_process"
    DRIVELINE_ENGAGED = "driveline_engaged"
    RETARDER_FRACTION = "retarder_fraction"
    PARK_BRAKE = "park_brake"
    GRADE = "grade"
    ALTITUDE = "altitude"
    LONGITUDINAL_ACCELERATION = "longitudinal_acceleration"
    LATERAL_ACCELERATION = "lateral_acceleration"
    YAW_RATE = "yaw_rate"
    HEADING = "heading"
    GPS_SPEED = "gps_speed"
    AMBIENT_TEMPERATURE = "ambient_temperature"
    AIR_PRESSURE = "air_pressure"
    COOLANT_TEMPERATURE = "coolant_temperature"
    FAN_SPEED = "fan_speed"
    BATTERY_VOLTAGE = "battery_voltage"
    BATTERY_CURRENT = "battery_current"
    LATITUDE = "latitude"
    LONGITUDE = "longitude"
    MASS_REFERENCE = "mass_reference"
    GRADE_REFERENCE = "grade_reference"


# Estimates of other control units: shown beside the estimate, which does not depend on them.
REFERENCES = frozenset({Role.MASS_REFERENCE, Role.GRADE_REFERENCE})
GRADES = frozenset({Role.GRADE, Role.GRADE_REFERENCE})  # rise over run; an angle does as well
BATTERY = frozenset({Role.BATTERY_VOLTAGE, Role.BATTERY_CURRENT})


def is_electric(bound: Set[str]) -> bool:
    """True if power is that of the battery: its roles are ``bound``, and no engine power or torque is."""
    return bound >= BATTERY and not bound & {Role.ENGINE_POWER, Role.ENGINE_TORQUE}


class Quantity(StrEnum):
    """Quantities of a moment besides speed and power, derived from roles, in SI."""

    ENGINE_SPEED = "engine speed"  # [rad/s]
    GEAR = "gear"
    HEADING = "heading"  # [rad], clockwise from north
    LATERAL_ACCELERATION = "lateral acceleration"  # [m/s^2]
    FAN_SPEED = "fan speed"  # [rad/s]
    BATTERY_CURRENT = "battery current"  # [A], with the sign of the bus
    BRAKE = "brake"  # share of the pedal's way, or 1
    CLIMB_BY_GRADE = "climb by grade"  # [m/s], vertical speed
    CLIMB_BY_ALTITUDE = "climb by altitude"  # [m/s]
    CLIMB_BY_ACCELEROMETER = "climb by accelerometer"  # [m/s]
    TEMPERATURE = "temperature"  # [K], of the air
    AIR_DENSITY = "air density"  # [kg/m^3]
    ELAPSED = "elapsed"  # [s] since the drive began
    DISTANCE = "distance"  # [m] since the drive began
    STOPS = "stops"  # standstills so far
    SPEED_OVER_10_MIN = "speed over 10 min"  # [m/s], low-passed with that time constant; 0 before the drive
    SPEED_OVER_20_MIN = "speed over 20 min"
    SPEED_OVER_40_MIN = "speed over 40 min"
    SPEED_OVER_80_MIN = "speed over 80 min"
    FROZEN = "frozen"  # 1 where speed and power no longer change on the move
    SPEED_STEP = "step of the speed"  # [m/s], where the bus sends it in coarse ones
    CONTRADICTED = "contradicted"  # 1 where half of the wheels contradict the others
    GRADE_OFFSET_SD = "offset sd of the grade"  # [1], of the constant error of a map's slope


PAST_SPEEDS: dict[Quantity, float] = {  # [s], time constants in rising order
    Quantity.SPEED_OVER_10_MIN: 600.0,
    Quantity.SPEED_OVER_20_MIN: 1200.0,
    Quantity.SPEED_OVER_40_MIN: 2400.0,
    Quantity.SPEED_OVER_80_MIN: 4800.0,
}


STATE = "state"  # dimension of switches and gear numbers: taken as they are
_DIMENSIONS: dict[str, tuple[Role, ...]] = {
    "m/s": (Role.SPEED, Role.WHEEL_SPEEDS, Role.GPS_SPEED),
    "W": (Role.ENGINE_POWER,),
    "N.m": (Role.ENGINE_TORQUE, Role.REFERENCE_TORQUE),
    "rad/s": (Role.ENGINE_SPEED, Role.YAW_RATE, Role.FAN_SPEED),
    "1": (
        Role.TORQUE_FRACTION,
        Role.TORQUE_FRACTION_FINE,
        Role.FRICTION_FRACTION,
        Role.PARASITIC_FRACTION,
        Role.BRAKE_PEDAL,
        Role.RETARDER_FRACTION,
        Role.GRADE,
        Role.GRADE_REFERENCE,
    ),
    STATE: (
        Role.GEAR,
        Role.BRAKE_SWITCH,
        Role.CLUTCH_SWITCH,
        Role.SHIFT_IN_PROCESS,
        Role.DRIVELINE_ENGAGED,
        Role.PARK_BRAKE,
    ),
    "kg": (Role.MASS_REFERENCE,),
    "m": (Role.ALTITUDE,),
    "m/s^2": (Role.LONGITUDINAL_ACCELERATION, Role.LATERAL_ACCELERATION),
    "rad": (Role.HEADING, Role.LATITUDE, Role.LONGITUDE),
    "K": (Role.AMBIENT_TEMPERATURE, Role.COOLANT_TEMPERATURE),
    "Pa": (Role.AIR_PRESSURE,),
    "V": (Role.BATTERY_VOLTAGE,),
    "A": (Role.BATTERY_CURRENT,),
}
DIMENSION: dict[Role, str] = {role: unit for unit, roles in _DIMENSIONS.items() for role in roles}
