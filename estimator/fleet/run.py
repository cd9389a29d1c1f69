"""Run of a fleet: survey logs, estimate each drive, pool the drives of each vehicle, compare vehicles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from estimator.can_io.bound_traffic import bound_messages
from estimator.config import Config
from estimator.errors import ConfigError
from estimator.estimation.evidence import Coefficients
from estimator.estimation.load_segments import SHORT_STOP
from estimator.false_discovery import false_discovery_rates
from estimator.fleet.cache import Cache
from estimator.fleet.drive_result import DriveResult, estimate_drive
from estimator.fleet.engine import Engine, Failure
from estimator.fleet.grouping import Drive, Grouped, by_engine, group
from estimator.fleet.over_time import newest
from estimator.fleet.pooling import Mixture
from estimator.fleet.population import MIN_VEHICLES, population
from estimator.fleet.road import LearnedRoad, learned
from estimator.fleet.seasons import SeasonResult, by_season
from estimator.fleet.sources import LogFile
from estimator.fleet.survey import Survey, survey
from estimator.fleet.vehicles import DRAG, ROLLING, VehicleResult, join
from estimator.model.effects import named
from estimator.road_map import RoadMap
from estimator.settings import Gate
from estimator.signals import Floats

Joined = tuple[VehicleResult, tuple[SeasonResult, ...]]
Progress = Callable[[float], None]
SURVEYING = 0.05  # share of the work
MIN_SCALE = 1e-3  # of the scatter between drives, where `load.change_sd` is 0: its prior needs a width


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Result of a fleet: logs grouped to drives, results of drives, vehicles, their seasons, and their comparison.

    ``seasons`` are those of each vehicle, in the order of vehicles. ``q_values`` (n, 2) are false-discovery rates of
    A/m and C of the vehicles, NaN if not compared. ``new`` are the distributions of A/m and C of a new vehicle, empty
    if there are too few vehicles. ``road`` has the slopes of places that the drives show.
    """

    grouped: Grouped
    results: tuple[DriveResult, ...]
    vehicles: tuple[VehicleResult, ...]
    seasons: tuple[tuple[SeasonResult, ...], ...]
    q_values: Floats
    new: tuple[Mixture, ...]
    road: LearnedRoad


@dataclass(frozen=True)
class _Vehicle:
    """Likelihoods of the loads of a vehicle, their starts [s], and a reason not to pool them, else empty."""

    name: str
    loads: list[Coefficients]
    starts: list[float]
    doubt: str


def check(config: Config) -> None:
    """Refuse a configuration with which no drive can be estimated, before the estimates.

    Raises
    ------
    InputError
        The likelihood is not "road", loads share their driving, an effect is unknown, or the databases or the map do
        not fit.
    """
    if config.sampler.likelihood != "road":
        raise ConfigError('sampler.likelihood: drives are joined with "road" only; take the key out')
    if config.load.stop_s < SHORT_STOP:
        least = f"{SHORT_STOP:g} or more"
        raise ConfigError(
            f"load.stop_s: loads between shorter stops share their driving; give {least}, or leave it out"
        )
    named(config.effects)
    bound_messages(config)
    if config.road.map is not None:
        RoadMap.read(Path(config.road.map))


def run_fleet(
    logs: Sequence[LogFile],
    config: Config,
    engine: Engine,
    *,
    cache: Cache | None = None,
    with_diagnosis: bool = False,
    are_named: bool = False,
    progress: Progress = lambda share: None,
) -> Fleet:
    """Estimate the drives and vehicles of a fleet; if ``are_named``, vehicles are those of the engines' NAMEs.

    `check` must have been called with the configuration.
    """
    surveys = _surveys(logs, config, engine, progress)
    grouped = group(by_engine(surveys) if are_named else surveys)
    results = _results(grouped.drives, config, engine, cache, with_diagnosis, progress)
    return conclude(grouped, results, config, engine)


def conclude(grouped: Grouped, results: tuple[DriveResult, ...], config: Config, engine: Engine) -> Fleet:
    """Pool the drives of each vehicle and compare the vehicles, given the result of each drive."""
    joined = _vehicles(grouped, results, config, engine)
    vehicles = tuple(vehicle for vehicle, _ in joined)
    compared, new = _outlier_rates(vehicles)
    seasons = tuple(seasons for _, seasons in joined)
    road = learned([drive.vehicle for drive in grouped.drives], [result.passes for result in results])
    return Fleet(
        grouped=grouped, results=results, vehicles=vehicles, seasons=seasons, q_values=compared, new=new, road=road
    )


def _surveys(logs: Sequence[LogFile], config: Config, engine: Engine, progress: Progress) -> list[Survey]:
    surveys: dict[int, Survey] = {}
    for done, (i, result) in enumerate(engine.map(partial(survey, config=config), logs), start=1):
        if isinstance(result, Failure):
            fault = f"{logs[i].source}: {result.reason}"
            result = Survey(log=logs[i], content="", start=0.0, end=0.0, fault=fault)
        surveys[i] = result
        progress(SURVEYING * done / len(logs))
    return [surveys[i] for i in range(len(logs))]


def _results(
    drives: Sequence[Drive],
    config: Config,
    engine: Engine,
    cache: Cache | None,
    with_diagnosis: bool,
    progress: Progress,
) -> tuple[DriveResult, ...]:
    """Results of the drives in order, from the cache or computed; computed ones without a fault are cached."""
    kept = [None if cache is None else cache.get(drive) for drive in drives]
    missing = [i for i, result in enumerate(kept) if result is None]
    work = partial(estimate_drive, config=config, with_diagnosis=with_diagnosis)
    for done, (i, result) in enumerate(engine.map(work, [drives[i] for i in missing]), start=1):
        if isinstance(result, Failure):
            kept[missing[i]] = DriveResult(fault=result.reason)
        else:
            kept[missing[i]] = result
            if cache is not None and not result.fault:
                cache.put(drives[missing[i]], result)
        progress(SURVEYING + (1 - SURVEYING) * done / len(missing))
    return tuple(result for result in kept if result is not None)


def _vehicles(grouped: Grouped, results: Sequence[DriveResult], config: Config, engine: Engine) -> list[Joined]:
    names = sorted({drive.vehicle for drive in grouped.drives})
    vehicles = {name: _Vehicle(name, [], [], _doubt(grouped.overlapping(name))) for name in names}
    for drive, result in zip(grouped.drives, results, strict=True):
        for segment in result.segments:
            if (coefficients := segment.coefficients) is not None:
                vehicles[drive.vehicle].loads.append(coefficients)
                vehicles[drive.vehicle].starts.append(segment.start)
    gate, scale = config.gate, max(config.load.change_sd, MIN_SCALE)
    by_index: dict[int, Joined] = {}
    last = newest([start for vehicle in vehicles.values() for start in vehicle.starts])
    for i, answer in engine.map(partial(_joined, gate=gate, scale=scale, last=last), list(vehicles.values())):
        if isinstance(answer, Failure):
            answer = join(names[i], (), (), gate, scale, answer.reason), ()
        by_index[i] = answer
    return [by_index[i] for i in range(len(names))]


def _joined(vehicle: _Vehicle, gate: Gate, scale: float, last: float | None) -> Joined:
    whole = join(vehicle.name, vehicle.loads, vehicle.starts, gate, scale, vehicle.doubt, last)
    return whole, by_season(whole, vehicle.loads, vehicle.starts, gate, scale)


def _doubt(overlapping: int) -> str:
    if not overlapping:
        return ""
    drives = f"{overlapping} of its drives overlap{'s' * (overlapping == 1)} others in time"
    return f"{drives}: two vehicles in one folder? give --vehicle"


def _outlier_rates(vehicles: Sequence[VehicleResult]) -> tuple[Floats, tuple[Mixture, ...]]:
    """False-discovery rates (n, 2) of A/m and C over all comparisons, and the distributions of a new vehicle."""
    rates = np.full((len(vehicles), 2), np.nan)
    new: list[Mixture] = []
    for i in (ROLLING, DRAG):
        estimated = [
            (v, marginal) for v, vehicle in enumerate(vehicles) if (marginal := vehicle.compared[i]) is not None
        ]
        if len(estimated) < MIN_VEHICLES:
            continue
        means, sds = (np.array([getattr(marginal, part) for _, marginal in estimated]) for part in ("mean", "sd"))
        compared = population(means, sds)
        rates[[v for v, _ in estimated], i] = compared.p_values
        new.append(compared.new)
    shown = np.isfinite(rates)
    if shown.any():
        rates[shown] = false_discovery_rates(rates[shown])
    return rates, tuple(new) if len(new) == 2 else ()
