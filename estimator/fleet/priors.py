"""Configurations from a fleet: priors (beliefs) of A and C with which a gateway begins its first drive."""

from collections.abc import Sequence
from math import sqrt
from pathlib import Path

import msgspec
import numpy as np

from estimator import config as configuration
from estimator import toml_text
from estimator.config import Config
from estimator.errors import ConfigError
from estimator.fleet.pooling import Mixture
from estimator.fleet.vehicles import DRAG, ROLLING, Normal, VehicleResult


def with_beliefs(config: Config, load: Normal, rolling: Normal, drag: Normal) -> Config:
    """Add priors (beliefs) of A and C on the next drive to a configuration.

    ``load`` is the expected mass [kg], ``rolling`` A/m [N/kg], ``drag`` C [N s^2/m^2], each with its sd. The sd of A
    allows for other loads. The mass has no such prior, because it changes with the load.

    Raises
    ------
    ConfigError
        The boxes of the configuration exclude a belief.
    """
    mass, mass_sd = load
    ratio, ratio_sd = rolling
    A = ratio * mass, sqrt((ratio_sd * mass) ** 2 + (ratio * mass_sd) ** 2)
    prior = msgspec.structs.replace(config.prior, A_belief_N=A, C_belief_N_s2_m2=drag)
    changed = configuration.replace(config, prior=prior)
    configuration.check(changed)
    return changed


def of_vehicle(config: Config, result: VehicleResult) -> Config | None:
    """Configuration with the beliefs of a vehicle; None if A/m or C is not estimated, or the boxes exclude it."""
    if result.rolling is None or result.drag is None or result.next_drive is None or result.load is None:
        return None
    rolling, drag = result.next_drive
    return _allowed(config, result.load, (rolling.mean, rolling.sd), (drag.mean, drag.sd))


def of_new_vehicle(config: Config, results: Sequence[VehicleResult], new: Sequence[Mixture]) -> Config | None:
    """Configuration for a new vehicle of this fleet's type; ``new`` are the distributions of its A/m and C."""
    loaded = [result for result in results if result.load is not None]
    if not loaded or not new:
        return None
    means = np.array([result.load[0] for result in loaded if result.load is not None])
    variances = np.array([result.load[1] ** 2 for result in loaded if result.load is not None])
    load = float(means.mean()), float(np.sqrt(variances.mean() + means.var()))
    rolling, drag = (_on_one_drive(new[i], [result.scatter[i] for result in loaded]) for i in (ROLLING, DRAG))
    return _allowed(config, load, rolling, drag)


def _on_one_drive(new: Mixture, scatter: Sequence[float]) -> Normal:
    """Mean and sd of a new vehicle's value on one drive, which includes the scatter between drives."""
    marginal = new.marginal
    return marginal.mean, sqrt(marginal.sd**2 + sum(s**2 for s in scatter) / len(scatter))


def _allowed(config: Config, load: Normal, rolling: Normal, drag: Normal) -> Config | None:
    try:
        return with_beliefs(config, load, rolling, drag)
    except ConfigError:  # the configured boxes exclude the population: no belief is possible
        return None


def as_toml(config: Config) -> str:
    """Convert a configuration to TOML that is valid in any folder: paths of databases and map are absolute."""
    databases = [str(Path(name).resolve()) for name in config.bus.dbc]
    road_map = None if config.road.map is None else str(Path(config.road.map).resolve())
    whole = configuration.replace(
        config,
        bus=msgspec.structs.replace(config.bus, dbc=databases),
        lake=None,  # a gateway hears frames
        road=msgspec.structs.replace(config.road, map=road_map),
    )
    return toml_text.dump(msgspec.to_builtins(whole))
