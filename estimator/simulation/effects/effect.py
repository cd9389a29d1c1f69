"""Requested effect: its name, magnitude and span; and draws of the fields that are None."""

from dataclasses import dataclass

import numpy as np

from estimator.simulation.moment import Scene

Span = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """Requested deviation of the simulated drive from the plain road load.

    ``magnitude`` is in the unit of the effect's kind. ``start`` and ``end`` [s] bound it in time. ``direction`` [rad]
    is that from which a wind comes, clockwise from north. Fields that are None are drawn.
    """

    name: str
    magnitude: float
    start: float | None = None
    end: float | None = None
    direction: float | None = None


def window(scene: Scene, effect: Effect, shortest: float = 0.12, longest: float = 0.3) -> Span:
    """One stretch of time [s]; its length, if not given, is a share of the drive."""
    if effect.start is not None:
        return effect.start, scene.duration if effect.end is None else effect.end
    length = scene.rng.uniform(shortest, longest) * scene.duration
    start = scene.rng.uniform(0.1 * scene.duration, 0.9 * scene.duration - length)
    return start, start + length


def episodes(scene: Scene, effect: Effect, off: Span, on: Span) -> list[Span]:
    """Random stretches of time [s], with durations from ``shortest`` to ``longest`` [s]; or the given one."""
    if effect.start is not None:
        return [window(scene, effect)]
    rng, stretches = scene.rng, []
    t = float(rng.uniform(0.0, off[1]))
    while t < scene.duration:
        end = min(t + float(rng.uniform(*on)), scene.duration)
        stretches.append((t, end))
        t = end + float(rng.uniform(*off))
    return stretches


def switched(spans: list[Span], duration: float, spacing: float) -> list[bool]:
    """Flag each moment, ``spacing`` [s] apart, that lies in one of the stretches."""
    t = spacing * np.arange(round(duration / spacing) + 2)
    inside = np.zeros(len(t), bool)
    for start, end in spans:
        inside |= (t >= start) & (t < end)
    states: list[bool] = inside.tolist()
    return states
