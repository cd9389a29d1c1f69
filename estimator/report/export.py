"""Draws of the posterior in a file: CSV and JSON always, NetCDF for ArviZ where it is installed."""

import csv
import json
from pathlib import Path

from estimator.errors import ConfigError, RoadloadError
from estimator.estimation.posterior import Posterior

NAMES = ("A_N", "C_N_s2_m2", "mass_kg")  # order of the draws' last axis
FORMATS = (".csv", ".json", ".nc")


def check_format(path: Path) -> None:
    """Refuse a file name early, before the work is done.

    Raises
    ------
    ConfigError
        The suffix is none of FORMATS.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: draws are written as one of {', '.join(FORMATS)}")


def write_draws(posterior: Posterior, path: Path) -> None:
    """Write the draws of A, C and m to ``path``; the suffix says how.

    Raises
    ------
    RoadloadError
        The file cannot be written, or .nc is asked for without ArviZ.
    """
    check_format(path)
    temporary = path.with_name(f".{path.name}.part")
    try:
        {".csv": _csv, ".json": _json, ".nc": _netcdf}[path.suffix.lower()](posterior, temporary)
        temporary.replace(path)
    except OSError as error:
        raise RoadloadError(f"{path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _csv(posterior: Posterior, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["chain", "draw", *NAMES])
        for i, chain in enumerate(posterior.draws[:, :, : len(NAMES)].tolist()):
            table.writerows([i, j, *draw] for j, draw in enumerate(chain))


def _json(posterior: Posterior, path: Path) -> None:
    draws = {name: posterior.draws[:, :, i].tolist() for i, name in enumerate(NAMES)}
    path.write_text(json.dumps({"dims": ["chain", "draw"], "posterior": draws}), encoding="utf-8")


def _netcdf(posterior: Posterior, path: Path) -> None:
    try:
        import arviz
    except ImportError as error:
        raise RoadloadError(f"{path.suffix} needs ArviZ: pip install 'roadload[arviz]'") from error
    draws = {name: posterior.draws[:, :, i] for i, name in enumerate(NAMES)}
    arviz.from_dict(posterior=draws).to_netcdf(str(path))
