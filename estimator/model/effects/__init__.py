"""Catalogue of effects that the plain road load leaves out."""

from estimator.model.effects.catalogue import BY_NAME, CATALOGUE, named
from estimator.model.effects.effect import SOURCES, Context, Effect, Shape, Timing, View, obstacle, way_past_obstacle
from estimator.model.effects.unbound import unbound

__all__ = [
    "BY_NAME",
    "CATALOGUE",
    "SOURCES",
    "Context",
    "Effect",
    "Shape",
    "Timing",
    "View",
    "named",
    "obstacle",
    "unbound",
    "way_past_obstacle",
]
