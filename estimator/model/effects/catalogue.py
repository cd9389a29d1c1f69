"""All effects that the diagnosis can name and the estimator can add; a new one is a new object in the list.

Effects are tried, and printed without a ranking, in the order of the list.
"""

from collections.abc import Sequence

from estimator.errors import ConfigError
from estimator.model.effects import air, electric, powertrain, readings, road
from estimator.model.effects.effect import Effect
from estimator.near_names import did_you_mean

CATALOGUE: tuple[Effect, ...] = (
    road.GRADE,
    air.HEADWIND,
    air.AIR_DENSITY,
    road.WARM_UP,
    powertrain.VISCOUS_DRAG,
    powertrain.OIL_WARM_UP,
    powertrain.COLD_LOSS,
    readings.TORQUE_GAIN,
    powertrain.LOAD_LOSS,
    readings.TORQUE_BIAS,
    powertrain.AUXILIARY_LOAD,
    powertrain.AUXILIARY_CYCLING,
    powertrain.ROTATING_INERTIA,
    road.MASS_STEP,
    road.RESISTANCE_SEGMENT,
    road.CORNERING,
    readings.SENSOR_DRIFT,
    readings.SPEED_SCALE,
    road.BRAKE_USE,
    readings.TIME_LAG,
    readings.SPEED_FILTER,
    air.DRAFTING,
    electric.REGENERATION_LOSS,
    electric.CABIN_HEATER,
)

BY_NAME = {effect.name: effect for effect in CATALOGUE}


def named(names: Sequence[str]) -> tuple[Effect, ...]:
    """Return the effects that a configuration names.

    Raises
    ------
    ConfigError
        A name is unknown, or only a diagnosis can find the times of the effect.
    """
    able = ", ".join(effect.name for effect in CATALOGUE if effect.is_streaming)
    for name in names:
        if name not in BY_NAME:
            guess = did_you_mean(name, BY_NAME) or f"; there are {able}"
            raise ConfigError(f"effects: {name!r} is not known{guess}")
        if not BY_NAME[name].is_streaming:
            raise ConfigError(f"effects: {name!r} cannot be part of the model, only diagnosed; those that can: {able}")
    return tuple(BY_NAME[name] for name in dict.fromkeys(names))
