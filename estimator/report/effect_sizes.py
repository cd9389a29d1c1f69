"""Magnitudes of the effects in the model of an estimate, in words."""

from estimator.estimates import Marginal
from estimator.model.effects import BY_NAME
from estimator.model.effects.unbound import BY_ROLE
from estimator.report import number_format

UNITS = {effect.name: effect.unit for effect in (*BY_NAME.values(), *BY_ROLE.values())}


def effect_size(name: str, size: Marginal) -> str:
    """``5.74 m/s (5.44 .. 6.05)``: mean and 90 % interval."""
    return number_format.with_interval(size.mean, size.q05, size.q95, UNITS[name])
