"""Output folder of a fleet."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from estimator.answers.answer import encode
from estimator.config import Config
from estimator.errors import ConfigError
from estimator.fleet.exports import export
from estimator.fleet.page import Tables, page
from estimator.fleet.priors import as_toml, of_new_vehicle, of_vehicle
from estimator.fleet.rows import drive_rows, effect_rows, road_rows, season_rows, vehicle_rows
from estimator.fleet.run import Fleet
from estimator.fleet.tables import CSV, DRIVES, EFFECTS, ROAD, SEASONS, VEHICLES, write_tables

CACHE = "cache"  # folders in the output
PRIORS = "priors"
EXPORTS = "exports"
PAGE = "fleet.html"
ROAD_TABLE, ROAD_MAP = "road.parquet", "road.npy"
TABLES = ("drives", "vehicles", "seasons", "effects", "road")
NEW_VEHICLE = "new-vehicle"
OF_FILES = (".csv", ".parquet", ".json", ".html")  # suffixes by which a name is meant as that of a file
MAX_NAME = 200  # bytes of the name of a vehicle in that of a file, which file systems allow 255 of
FORBIDDEN = str.maketrans(dict.fromkeys('/\\:*?"<>|', "_"))  # in names of files


def prepare(out: Path) -> None:
    """Make the folder, before the estimates.

    Raises
    ------
    ConfigError
        The path is a file or named like one, or the folder cannot be made or written to.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give the name of a folder")
    if out.suffix.lower() in OF_FILES:
        raise ConfigError(f"{out}: is named like a file; give the name of a folder, in which the tables are written")
    for folder in (out, out / PRIORS, out / EXPORTS, out / CACHE):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be made ({error.strerror}); give another folder with -o") from error
        if not os.access(folder, os.W_OK | os.X_OK):
            raise ConfigError(f"{folder}: must not be written to; check its permissions, or give another with -o")


def check_names(vehicles: Iterable[str]) -> None:
    """Refuse vehicles whose files would have one name, before the estimates.

    Raises
    ------
    ConfigError
        There are such vehicles; the message names them.
    """
    named = {NEW_VEHICLE: "the belief about a new vehicle"}
    for vehicle in sorted(set(vehicles)):
        name = _file_name(vehicle).casefold()
        if name in named:
            raise ConfigError(f"vehicles {vehicle!r} and {named[name]!r} would have one file; rename one of them")
        named[name] = vehicle


def write_fleet(
    fleet: Fleet, config: Config, out: Path, rate: float, *, with_diagnosis: bool = False, with_page: bool = False
) -> list[Path]:
    """Write tables, configurations and, if ``with_page``, the page: all files or none; returns their names.

    ``rate`` is the false-discovery rate up to which a vehicle is named as an outlier.

    Raises
    ------
    RoadloadError
        A file cannot be written.
    """
    drives, vehicles, seasons, effects = (
        drive_rows(fleet),
        vehicle_rows(fleet, rate),
        season_rows(fleet),
        effect_rows(fleet),
    )
    tables = {
        out / "drives.parquet": (DRIVES, drives),
        out / "vehicles.parquet": (VEHICLES, vehicles),
        out / "seasons.parquet": (SEASONS, seasons),
    }
    if with_diagnosis:
        tables[out / "effects.parquet"] = EFFECTS, effects
    learnt = {result.vehicle: of_vehicle(config, result) for result in fleet.vehicles}
    learnt[NEW_VEHICLE] = of_new_vehicle(config, fleet.vehicles, fleet.new)
    texts = {out / PRIORS / f"{_file_name(name)}.toml": as_toml(c) for name, c in learnt.items() if c is not None}
    if with_page:
        of = Tables(drives=drives, vehicles=vehicles, seasons=seasons, effects=effects, road=fleet.road, rate=rate)
        texts[out / PAGE] = page(of)
    exported = {out / EXPORTS / f"{_file_name(result.vehicle)}.json": export(result) for result in fleet.vehicles}
    texts |= {path: encode(answer).decode() + "\n" for path, answer in exported.items() if answer is not None}
    maps: dict[Path, bytes] = {}
    if len(fleet.road.key):
        tables[out / ROAD_TABLE] = ROAD, road_rows(fleet.road)
    if len(fleet.road.map.key):  # else a map that a gateway uses stays as it is
        maps[out / ROAD_MAP] = fleet.road.map.encoded()
    return write_tables(tables, {**texts, **maps})


def left_over(out: Path, written: Sequence[Path]) -> list[Path]:
    """Files of an earlier run in the folder that are not among those ``written`` by this run."""
    tables = [out / f"{name}{suffix}" for name in TABLES for suffix in (".parquet", CSV)]
    made = [*tables, out / PAGE, out / ROAD_MAP, *out.glob(f"{PRIORS}/*"), *out.glob(f"{EXPORTS}/*")]
    return sorted(path for path in made if path.is_file() and path not in set(written))


def _file_name(vehicle: str) -> str:
    return vehicle.translate(FORBIDDEN).lstrip(".").encode()[:MAX_NAME].decode(errors="ignore") or "_"
