"""Road from a driving cycle: a table of speed, by time or by distance, optionally with grade.

Speeds of the table are limits at their places. The truck stops where the table has speed zero, for an equal time. A
slow truck so takes longer, but drives the same road.
"""

import csv
from pathlib import Path

import numpy as np

from estimator.errors import InputError
from estimator.input_files import MIB, read_bounded
from estimator.signals import Floats
from estimator.simulation.bends import curvature_of
from estimator.simulation.route import GRADE_SPACING, Route

COLUMNS = "t_s,v_mps or s_m,v_mps, and grade"
MAX_FILE_BYTES = 4 * MIB  # bytes of a table; a day of seconds has half of it
MAX_DURATION = 1e6  # s, of a table by time: more than the longest drive
STANDSTILL = 0.1  # m/s
MIN_SPEED = 2.0  # m/s between stops: a limit of nearly nothing would never be left again
SECOND = 1.0  # s, grid of a table by time
DWELL = 10.0  # s, at a standstill of a table by distance


def cycle_route(path: Path, length: float, rng: np.random.Generator) -> Route:
    """Read a table (``t_s`` or ``s_m``, ``v_mps``, optionally ``grade``) and repeat it over ``length`` [m].

    Raises
    ------
    InputError
        The file cannot be read, lacks a column, or is not a cycle.
    """
    table = _read(path)
    v = table["v_mps"]
    t = table.get("t_s")
    if t is not None:
        s = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    else:
        s = table["s_m"] - table["s_m"][0]
    around = float(s[-1])
    if around < 10 * GRADE_SPACING:
        raise InputError(f"{path}: the cycle is {around:.0f} m long; give one of some hundred metres at least")
    stop, dwell = _stops(s, v, t)
    rolling = (v >= STANDSTILL) & (np.diff(s, append=np.inf) > 0.0)
    start, speed = s[rolling], np.maximum(v[rolling], MIN_SPEED)
    rounds = int(np.ceil(length / around))
    shift = around * np.arange(rounds)[:, None]
    starts, speeds = (start + shift).ravel(), np.tile(speed, rounds)
    starts[0] = 0.0
    road = rounds * around
    stops, dwells = (stop + shift).ravel(), np.tile(dwell, rounds)
    stops, once = np.unique(np.round(stops), return_inverse=True)  # standing at the end and at the start is one stop
    dwells = np.bincount(once, dwells).astype(np.float64)
    inside = (stops > 0.0) & (stops < road - GRADE_SPACING)
    distance = GRADE_SPACING * np.arange(int(road / GRADE_SPACING) + 2)
    grade = np.interp(distance % around, s, table["grade"]) if "grade" in table else np.zeros(len(distance))
    return Route(
        section_start=starts,
        section_speed=speeds,
        stop_position=np.append(stops[inside], road),
        stop_dwell=np.append(dwells[inside], np.inf),
        grade=grade,
        curvature=curvature_of(starts, speeds, [], road, rng),
        start_heading=rng.uniform(0.0, 2 * np.pi),
    )


def _stops(s: Floats, v: Floats, t: Floats | None) -> tuple[Floats, Floats]:
    """Places [m] and durations [s] of the standstills of the cycle."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], v < STANDSTILL, [False]]).astype(int)))
    first, last = edges[::2], edges[1::2] - 1
    dwell = np.full(len(first), DWELL) if t is None else t[last] - t[first] + 1.0
    return s[first], dwell


def _read(path: Path) -> dict[str, Floats]:
    try:
        lines = read_bounded(path, MAX_FILE_BYTES).decode("utf-8-sig").splitlines(keepends=True)
        rows = list(csv.DictReader(line for line in lines if line.strip() and not line.startswith("#")))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV table: {error}") from error
    names = {"t_s", "s_m", "v_mps", "grade"} & set(rows[0] if rows else ())
    if "v_mps" not in names or not names & {"t_s", "s_m"}:
        raise InputError(f"{path}: no driving cycle; its columns must be {COLUMNS} if known")
    try:
        table = {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: a value is not a number: {error}") from error
    if not all(np.isfinite(column).all() for column in table.values()):
        raise InputError(f"{path}: a value is missing or not finite")
    if (table["v_mps"] < 0.0).any() or any((np.diff(table[name]) <= 0.0).any() for name in names & {"t_s", "s_m"}):
        raise InputError(f"{path}: times and distances must rise, and speeds not be negative")
    if "t_s" not in names:
        return table
    if table["t_s"][-1] - table["t_s"][0] > MAX_DURATION:
        raise InputError(f"{path}: a cycle of more than {MAX_DURATION:,.0f} s; give a part of it")
    t = np.arange(table["t_s"][0], table["t_s"][-1] + 0.5, SECOND)
    return {"t_s": t} | {name: np.interp(t, table["t_s"], table[name]) for name in names - {"t_s", "s_m"}}
