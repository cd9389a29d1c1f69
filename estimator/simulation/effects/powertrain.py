"""Effects between fuel and clutch: accessories on the crank, inertia of the engine."""

from estimator.simulation.effects.effect import Effect, Span, episodes, switched
from estimator.simulation.moment import FAN_SLIP, STEP, Action, Moment, Scene
from estimator.simulation.truck import Truck

THERMOSTAT = 353.15  # K, opens
FAN_ON, FAN_OFF = 369.15, 363.15  # K of the coolant
FAN_COOLING = 22.0  # K that the fan lowers the coolant's equilibrium by
COOLANT_TIME = 180.0  # s
COOLANT_RISE = 20.0  # K over the thermostat in the long run, at the power of level cruise
COOL_DAY_RISE = 8.0  # K, the same with a clean radiator on a cool day
RELEASED = FAN_SLIP**3  # share of its power that a released fan takes
CRUISE = 20.0  # m/s


def cruise_power(truck: Truck) -> float:
    """Power of level cruise [W]."""
    return (truck.A + truck.C * CRUISE**2) * CRUISE


def auxiliary_load(scene: Scene, effect: Effect) -> Action:
    """Constant power [W] of alternator, pumps and air conditioning."""
    return Action(power=lambda now: effect.magnitude)


def auxiliary_cycling(scene: Scene, effect: Effect) -> Action:
    """Power [W] of a fan with an on/off clutch, switched by the coolant, or by the air conditioning at random."""
    if effect.start is None and scene.rng.random() < 0.6:
        return _fan_by_coolant(scene, effect.magnitude)
    spans = episodes(scene, effect, off=(120.0, 480.0), on=(60.0, 300.0))
    on = switched(spans, scene.duration, 0.1)
    running: list[bool] = []

    def power(now: Moment) -> float:
        running.append(on[int(10.0 * now.t)])
        return effect.magnitude * (1.0 if running[-1] else RELEASED)

    return Action(power=power, fan=running, active=spans)


def _fan_by_coolant(scene: Scene, watts: float) -> Action:
    usual = cruise_power(scene.truck)
    hot = COOLANT_RISE * float(scene.rng.uniform(0.9, 1.2))
    temperature = THERMOSTAT + float(scene.rng.uniform(0.0, 10.0))
    on = False
    running: list[bool] = []
    coolant: list[float] = []
    active: list[Span] = []

    def power(now: Moment) -> float:
        nonlocal temperature, on
        load = max(now.force * now.v, 0.0) / usual
        target = THERMOSTAT + hot * load - (FAN_COOLING if on else 0.0)
        temperature += STEP / COOLANT_TIME * (target - temperature)
        if not on and temperature > FAN_ON:
            on = True
            active.append((now.t, scene.duration))
        elif on and temperature < FAN_OFF:
            on = False
            active[-1] = active[-1][0], now.t
        running.append(on)
        coolant.append(temperature)
        return watts * (1.0 if on else RELEASED)

    return Action(power=power, fan=running, coolant=coolant, active=active)


def air_compressor(scene: Scene, effect: Effect) -> Action:
    """Power [W] of the compressor of the air brakes, for some seconds whenever the reservoirs are low."""
    spans = episodes(scene, effect, off=(45.0, 180.0), on=(10.0, 30.0))
    on = switched(spans, scene.duration, 0.1)
    return Action(power=lambda now: effect.magnitude if on[int(10.0 * now.t)] else 0.0, active=spans)


def rotating_inertia(scene: Scene, effect: Effect) -> Action:
    """Inertia on the crank J [kg m^2], equal to a mass J gearing^2; that of the wheels is part of the moving mass."""
    return Action(inertia=lambda now: effect.magnitude * now.gearing * now.gearing if now.closed else 0.0)
