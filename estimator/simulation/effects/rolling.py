"""Effects of rolling: tyres, bends, brakes, loads, as forces [N] at the wheels."""

from math import exp

from estimator.simulation.bends import CURVE_SPACING
from estimator.simulation.effects.effect import Effect, episodes, switched, window
from estimator.simulation.moment import STEP, Action, Moment, Scene, along

CRUISE = 22.0  # m/s, speed at which warm tyres have their nominal resistance
CRUISE_RISE = 35.0  # K, warm tyres at cruise above ambient
SETTLING = 100  # steps towards the temperature at which heating and cooling are equal
SOFTENING = 20.0  # K over which the rubber's loss falls to 1/e
REFERENCE_FORCE = 20e3  # N


def warm_up(scene: Scene, effect: Effect) -> Action:
    """Cold tyres have more rolling resistance; rolling heats them, and the wind cools them faster while driving."""
    A = scene.truck.A
    time_constant = float(scene.rng.uniform(900.0, 2400.0))
    rise = 0.0

    def force(now: Moment) -> float:
        nonlocal rise
        excess = _excess(effect.magnitude, rise)
        rise += STEP / time_constant * (_heating(excess, now.v) - rise * _cooling(now.v))
        return A * excess

    return Action(force=force)


def settled_excess(magnitude: float, speed: float) -> float:
    """Excess of A over that at CRUISE, as a share [1], for tyres with the steady temperature of a ``speed`` [m/s]."""
    excess = magnitude
    for _ in range(SETTLING):
        excess = _excess(magnitude, _heating(excess, speed) / _cooling(speed))
    return excess


def _excess(magnitude: float, rise: float) -> float:
    """Excess of A over that at CRUISE [1], for tyres warmer than the air by ``rise`` [K]; ``magnitude`` when cold."""
    warm = exp(-CRUISE_RISE / SOFTENING)
    return magnitude * (exp(-rise / SOFTENING) - warm) / (1.0 - warm)


def _heating(excess: float, speed: float) -> float:
    """Heating [K] by rolling in a time constant, at a ``speed`` [m/s]."""
    return CRUISE_RISE * (1.0 + excess) * speed / CRUISE


def _cooling(speed: float) -> float:
    """Share [1] of the rise that the air removes in a time constant, at a ``speed`` [m/s]."""
    return 0.35 + 0.65 * speed / CRUISE


def viscous_drag(scene: Scene, effect: Effect) -> Action:
    """Drag of lubricants in proportion to speed: a share of A at 20 m/s."""
    slope = effect.magnitude * scene.truck.A / 20.0
    return Action(force=lambda now: slope * now.v)


def resistance_segment(scene: Scene, effect: Effect) -> Action:
    """Wet road or soft tyre for a limited time: a share of A more."""
    start, end = window(scene, effect)
    more = effect.magnitude * scene.truck.A
    return Action(force=lambda now: more if start <= now.t < end else 0.0, active=[(start, end)])


def slow_puncture(scene: Scene, effect: Effect) -> Action:
    """Tyre that loses air from some moment on: a rising share of A, given at the end of the drive."""
    start, _ = window(scene, effect)
    left = scene.duration - start
    more = effect.magnitude * scene.truck.A
    return Action(force=lambda now: more * max(now.t - start, 0.0) / left, active=[(start, scene.duration)])


def cornering(scene: Scene, effect: Effect) -> Action:
    """Drag of side-slipping tyres in bends, with the square of the lateral acceleration."""
    curvature = along(scene.route.curvature, CURVE_SPACING)

    def force(now: Moment) -> float:
        lateral = now.v * now.v * curvature(now.s)
        return effect.magnitude * lateral * lateral

    return Action(force=force)


def load_loss(scene: Scene, effect: Effect) -> Action:
    """Slip and gear teeth lose a share of the tractive force that grows with it, ``magnitude`` at 20 kN."""
    share = effect.magnitude / REFERENCE_FORCE
    return Action(force=lambda now: share * now.force * now.force)


def brake_use(scene: Scene, effect: Effect, shown: bool = False) -> Action:
    """A service brake that drags now and then while the engine pulls."""
    spans = episodes(scene, effect, off=(60.0, 240.0), on=(4.0, 25.0))
    on = switched(spans, scene.duration, 0.1)
    applied = 0.0

    def force(now: Moment) -> float:
        nonlocal applied
        drags = on[int(10.0 * now.t)] and now.v > 3.0 and now.force > 0.0
        applied += STEP / 0.25 * ((effect.magnitude if drags else 0.0) - applied)
        now.brake_light |= shown and drags
        return applied

    return Action(force=force, active=spans)


def brake_use_shown(scene: Scene, effect: Effect) -> Action:
    """A service brake that the driver uses while the engine pulls: the brake switch shows it."""
    return brake_use(scene, effect, shown=True)


def retarder_use(scene: Scene, effect: Effect) -> Action:
    """A retarder brakes instead of the service brake as far as it can; the brake switch stays off."""
    return Action(retarder=effect.magnitude)


def snow_plough(scene: Scene, effect: Effect) -> Action:
    """Snow that is pushed at low speed only."""

    def force(now: Moment) -> float:
        return effect.magnitude * max(0.0, min(1.0, now.v - 1.0, (12.0 - now.v) / 2.0))

    return Action(force=force)


def gear_loss(scene: Scene, effect: Effect) -> Action:
    """Torque lost at the crank by a bad bearing in one gear."""
    gear = int(scene.rng.integers(9, 12))
    return Action(force=lambda now: effect.magnitude * now.gearing if now.closed and now.gear == gear else 0.0)


def oil_drag(scene: Scene, effect: Effect) -> Action:
    """Cold axle and gearbox oil: a share of A at the start, until the transmitted power has warmed it."""
    truck = scene.truck
    usual = (truck.A + truck.C * CRUISE**2) * CRUISE
    time_constant = float(scene.rng.uniform(1200.0, 2400.0))
    rise = 0.0

    def force(now: Moment) -> float:
        nonlocal rise
        rise += STEP / time_constant * (55.0 * abs(now.force) * now.v / usual - rise)
        return effect.magnitude * truck.A * exp(-rise / 22.0) * (0.4 + 0.6 * now.v / CRUISE)

    return Action(force=force)


def liquid_surge(scene: Scene, effect: Effect) -> Action:
    """Liquid load that sloshes: a share of the mass, as a damped pendulum."""
    liquid = effect.magnitude * scene.truck.mass
    omega = float(scene.rng.uniform(1.5, 3.5))  # rad/s
    damping = 2.0 * float(scene.rng.uniform(0.04, 0.12)) * omega
    x = u = 0.0

    def force(now: Moment) -> float:
        nonlocal x, u
        u += STEP * (-now.a - damping * u - omega * omega * x)
        x += STEP * u
        return -liquid * (damping * u + omega * omega * x)

    return Action(force=force, inertia=lambda now: -liquid)
