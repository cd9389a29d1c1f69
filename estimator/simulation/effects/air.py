"""Effects of the air: wind by heading, density, slipstream. Forces [N] at the wheels."""

from math import atan2, hypot, pi

import numpy as np

from estimator.signals import Floats
from estimator.simulation.atmosphere import STANDARD_TEMPERATURE, pressure_at, relative_density
from estimator.simulation.bends import CURVE_SPACING
from estimator.simulation.effects.effect import Effect, episodes, switched
from estimator.simulation.moment import Action, Moment, Scene, along
from estimator.simulation.noise import correlated, smooth
from estimator.simulation.route import GRADE_SPACING

MAX_YAW = 0.26  # rad, at which the effect of the air's angle on the drag is greatest
TEN_DEGREES = pi / 18
DRAFTING_SPEED = 15.0  # m/s, below which there is no drafting


def headwind(scene: Scene, effect: Effect) -> Action:
    """Steady wind over ground [m/s], which acts by its angle to the road; oblique air also raises the drag area."""
    rng, C = scene.rng, scene.truck.C
    come_from = rng.uniform(0.0, 2 * pi) if effect.direction is None else effect.direction
    oblique = float(rng.uniform(0.0, 0.2))  # more drag area at 10 degrees
    bearing = scene.route.heading
    ahead = along(effect.magnitude * np.cos(come_from - bearing), CURVE_SPACING)
    aside = along(effect.magnitude * np.sin(come_from - bearing), CURVE_SPACING)

    def force(now: Moment) -> float:
        against, across = now.v + ahead(now.s), aside(now.s)
        yaw = min(atan2(abs(across), abs(against)), MAX_YAW) / TEN_DEGREES
        drag = C * (1.0 + oblique * yaw * yaw) * hypot(against, across) * against
        return drag - C * now.v * now.v

    return Action(force=force)


def wind_gusts(scene: Scene, effect: Effect) -> Action:
    """Gusts along the road, with mean zero."""
    C, length = scene.truck.C, float(scene.rng.uniform(15.0, 50.0))
    gust = along(smooth(int(scene.duration / 0.5) + 2, effect.magnitude, length, scene.rng), 0.5)

    def force(now: Moment) -> float:
        against = now.v + gust(now.t)
        return C * (against * abs(against) - now.v * now.v)

    return Action(force=force)


def air_density(scene: Scene, effect: Effect) -> Action:
    """Air that is thinner at altitude, and warmer by ``magnitude`` [K] at the end of the drive than at its start."""
    C, duration = scene.truck.C, scene.duration
    wander = correlated(int(duration / 60.0) + 2, 0.05 * abs(effect.magnitude), 10.0, scene.rng)

    def temperature(t: Floats) -> Floats:
        wandering = np.interp(t, 60.0 * np.arange(len(wander)), wander)
        warming: Floats = STANDARD_TEMPERATURE + effect.magnitude * (t / duration - 0.5) + wandering
        return warming

    minutes = 60.0 * np.arange(int(duration / 60.0) + 2)
    warmth = along(STANDARD_TEMPERATURE / temperature(minutes), 60.0)
    thinness = along(relative_density(pressure_at(scene.route.altitude), np.array(STANDARD_TEMPERATURE)), GRADE_SPACING)

    def force(now: Moment) -> float:
        return C * now.v * now.v * (thinness(now.s) * warmth(now.t) - 1.0)

    return Action(force=force, temperature=temperature)


def drafting(scene: Scene, effect: Effect) -> Action:
    """Drive behind another truck for minutes at a time: a share less drag, varying with the gap."""
    C, rng = scene.truck.C, scene.rng
    spans = episodes(scene, effect, off=(180.0, 700.0), on=(180.0, 800.0))
    on = switched(spans, scene.duration, 0.1)
    closeness = along(np.clip(smooth(int(scene.duration) + 2, 0.1, 20.0, rng) + 1.0, 0.5, 1.3), 1.0)

    def force(now: Moment) -> float:
        if now.v < DRAFTING_SPEED or not on[int(10.0 * now.t)]:
            return 0.0
        return -effect.magnitude * closeness(now.t) * C * now.v * now.v

    return Action(force=force, active=spans)
