"""Effects that the plain road load leaves out, as objects."""

from estimator.effects.catalogue import BY_NAME, CATALOGUE, named
from estimator.effects.effect import SOURCES, Context, Effect, Shape, Timing, View

__all__ = ["BY_NAME", "CATALOGUE", "SOURCES", "Context", "Effect", "Shape", "Timing", "View", "named"]
