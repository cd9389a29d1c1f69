"""Effects that change the road: hills, a patchy surface, a stop to load or unload."""

from dataclasses import replace
from math import hypot

import numpy as np

from estimator.signals import Floats
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import on_the_ground, with_stop
from estimator.simulation.moment import Action, Moment, Scene, along
from estimator.simulation.noise import smooth
from estimator.simulation.route import GRADE_SPACING, Route
from estimator.units import STANDARD_GRAVITY

STOP_ZONE = 8.0  # m around a stop line
LOADING = 60.0, 240.0  # s, shortest and longest
HILLS = 300.0, 1200.0  # m over which the grade changes
PATCHES = 1500.0  # m over which the surface changes


def grade(scene: Scene, effect: Effect) -> Action:
    """Hills with a standard deviation of the slope, rise over run; equal on the way back and on every lap."""
    hills = _ground(scene.route, effect.magnitude, float(scene.rng.uniform(*HILLS)), scene.rng)
    met, sense = on_the_ground(scene.route, hills)
    return Action(route=replace(scene.route, grade=met * sense))


def road_surface(scene: Scene, effect: Effect) -> Action:
    """Asphalt of varying roughness: a share of A more or less, by place, equal in both directions."""
    surface, _ = on_the_ground(scene.route, _ground(scene.route, effect.magnitude, PATCHES, scene.rng))
    share, A = along(surface, GRADE_SPACING), scene.truck.A
    return Action(force=lambda now: A * share(now.s))


def mass_step(scene: Scene, effect: Effect) -> Action:
    """Loading, or unloading if negative, at a stop: mass and A change by a share while the truck stands."""
    rng, truck = scene.rng, scene.truck
    wanted = float(rng.uniform(0.3, 0.65)) * scene.duration if effect.start is None else effect.start
    route, stop = with_stop(scene.route, wanted, float(rng.uniform(*LOADING)))
    slope = along(route.grade, GRADE_SPACING)
    more_mass, more_rolling = effect.magnitude * truck.mass, effect.magnitude * truck.A
    active: list[tuple[float, float]] = []

    def inertia(now: Moment) -> float:
        if not active and now.v == 0.0 and abs(now.s - stop) < STOP_ZONE:
            active.append((now.t, scene.duration))
        return more_mass if active else 0.0

    def force(now: Moment) -> float:
        if not active:
            return 0.0
        rise = slope(now.s)
        return more_rolling + more_mass * STANDARD_GRAVITY * rise / hypot(1.0, rise)

    return Action(force=force, inertia=inertia, route=route, active=active)


def _ground(route: Route, sd: float, length: float, rng: np.random.Generator) -> Floats:
    """Smooth random profile (n,) of the ground along the road, every ``GRADE_SPACING``; closed for a loop."""
    covered = route.length if route.place is None else float(route.place.max())
    points = int(covered / GRADE_SPACING) + 3
    profile = smooth(points, sd, length / GRADE_SPACING / 2, rng)
    if route.lap is None:
        return profile
    around = round(route.lap / GRADE_SPACING)
    closed = profile[:around] - (profile[around] - profile[0]) * np.arange(around) / around
    closed = closed - closed.mean()
    spread = float(closed.std())
    return np.resize(closed * (sd / spread if spread > 0.0 else 1.0), points)
