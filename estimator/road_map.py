"""The map of slopes: places on the ground, and the file in which a fleet leaves what it learned of them.

A place is a cell of the ground and a direction of travel. Cells are CELL wide in both directions at any latitude: rows
of equal latitude, each cut into a whole number of columns. The two directions of a road are two places: they may be two
carriageways, and ramps and bridges lie in the cells of the roads that they cross.

The file is an array of `LAYOUT` in numpy's format, one record a place in ascending order, which a gateway reads with
numpy alone.
"""

import warnings
from dataclasses import dataclass
from io import BytesIO
from math import pi
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.typing import NDArray

from estimator.config import read_map
from estimator.errors import ConfigError
from estimator.signals import Floats
from estimator.units import EARTH_RADIUS

CELL = 100.0  # m, length and width of a cell
COURSES = 8  # directions of travel
MAX_SLOPE = 0.5  # rise over run: beyond that of any road
MAX_HEADER_BYTES = 1000
LAYOUT = np.dtype([("row", "<i4"), ("column", "<i4"), ("octant", "<i4"), ("slope", "<f4"), ("offset_sd", "<f4")])
_HEIGHT = CELL / EARTH_RADIUS  # rad, of a row
_ROWS = round(pi / 2 / _HEIGHT) + 1  # on either side of the equator
_COLUMN_BITS, _OCTANT_BITS = 20, 3  # of a key; a row of the equator has 400,300 columns

Cells = NDArray[np.int64]


def cells_at(latitude: Floats, longitude: Floats) -> tuple[Cells, Cells]:
    """Row and column (n,) of the cells at positions [rad] (n,), which are known."""
    row = np.floor(latitude / _HEIGHT).astype(np.int64)
    share = longitude / (2 * pi) % 1.0
    columns = _columns(row)
    return row, np.minimum(np.floor(share * columns).astype(np.int64), columns - 1)


def centre_of(row: Cells, column: Cells) -> tuple[Floats, Floats]:
    """Latitude and longitude [rad] (n,) of the centres of cells (n,), the longitude from -pi to pi."""
    turns = (column + 0.5) / _columns(row)
    return (row + 0.5) * _HEIGHT, 2 * pi * (turns - np.round(turns))


def octant_of(course: Floats) -> Cells:
    """Number (n,) from 0, north, to 7 of the direction of travel (n,) [rad], clockwise from north."""
    octant: Cells = np.round(course / (2 * pi) * COURSES).astype(np.int64) % COURSES
    return octant


def key_of(row: Cells, column: Cells, octant: Cells) -> Cells:
    """A number (n,) of its own for each place (n,), ascending by row, column and octant."""
    cell = ((row + _ROWS) << _COLUMN_BITS) + column
    key: Cells = (cell << _OCTANT_BITS) + octant
    return key


def place_of(key: Cells) -> tuple[Cells, Cells, Cells]:
    """Row, column and octant (n,) of keys (n,)."""
    cell = key >> _OCTANT_BITS
    return (cell >> _COLUMN_BITS) - _ROWS, cell & (1 << _COLUMN_BITS) - 1, key & (1 << _OCTANT_BITS) - 1


def _columns(row: Cells) -> Cells:
    """Number of columns (n,) of rows (n,), as many as fit at the latitude of their middle."""
    around = 2 * pi * np.maximum(np.cos((row + 0.5) * _HEIGHT), 0.0)
    columns: Cells = np.maximum(np.floor(around / _HEIGHT).astype(np.int64), 1)
    return columns


@dataclass(frozen=True)
class RoadMap:
    """Slopes, rise over run [1] (k,), of the places with these keys (k,), which ascend.

    ``offset_sd`` (k,) [1] is the sd of the error of the slope that a place has in common with those around it. What
    each has for itself is found from the drive, as the noise of a sensor is.
    """

    key: Cells
    slope: Floats
    offset_sd: Floats

    def at(self, latitude: Floats, longitude: Floats, course: Floats) -> tuple[Floats, Floats]:
        """Slope and sd of its offset [1] (n,) at positions (n,) [rad] in directions (n,) [rad].

        NaN where one of these is unknown, or there is no place.
        Where the octant of the direction has no place, the next nearest octant is taken.
        """
        slope, offset_sd = np.full((2, len(latitude)), np.nan)
        there = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(course))
        if not len(there) or not len(self.key):
            return slope, offset_sd
        row, column = cells_at(latitude[there], longitude[there])
        octant = octant_of(course[there])
        side = np.where(np.sin(course[there] - octant * (2 * pi / COURSES)) < 0, -1, 1)
        for wanted in ((octant + side) % COURSES, octant):
            key = key_of(row, column, wanted)
            at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
            hit = self.key[at] == key
            slope[there[hit]], offset_sd[there[hit]] = self.slope[at[hit]], self.offset_sd[at[hit]]
        return slope, offset_sd

    def encoded(self) -> bytes:
        """The contents of the file."""
        records = np.empty(len(self.key), LAYOUT)
        records["row"], records["column"], records["octant"] = place_of(self.key)
        records["slope"], records["offset_sd"] = self.slope, self.offset_sd
        file = BytesIO()
        np.lib.format.write_array(file, records, version=(1, 0), allow_pickle=False)
        return file.getvalue()

    @classmethod
    def read(cls, path: Path) -> "RoadMap":
        """The map in a file.

        Raises
        ------
        ConfigError
            The file is missing, too large, or not such a map.
        """
        data = read_map(path)
        try:
            return cls._decoded(data)
        except (ValueError, TypeError, SyntaxError, OverflowError, TokenError) as error:  # numpy parses Python there
            reason = " ".join(str(error).split())
            raise ConfigError(f"{path}: not a map of slopes: {reason}; give the road.npy of roadload fleet") from error

    @classmethod
    def _decoded(cls, data: bytes) -> "RoadMap":
        """The map of the contents of a file; ValueError with the reason where it is none."""
        file = BytesIO(data)
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError("another version of numpy's format")
        with warnings.catch_warnings(action="ignore", category=SyntaxWarning):  # the header is parsed as Python
            shape, _, layout = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER_BYTES)
        if layout != LAYOUT or len(shape) != 1:
            raise ValueError("other columns than row, column, octant, slope, offset_sd")
        if len(data) - file.tell() != shape[0] * LAYOUT.itemsize:
            raise ValueError(f"{shape[0]} places are promised, and the file is shorter or longer")
        records = np.frombuffer(data, LAYOUT, offset=file.tell())
        row, column, octant = (records[name].astype(np.int64) for name in ("row", "column", "octant"))
        slope, offset_sd = records["slope"].astype(float), records["offset_sd"].astype(float)
        wrong = ~(np.abs(row + 0.5) < _ROWS) | (column < 0) | (octant < 0) | (octant >= COURSES)
        wrong |= column >= _columns(row)
        wrong |= ~(np.abs(slope) <= MAX_SLOPE) | ~(offset_sd > 0) | ~np.isfinite(offset_sd)
        key = key_of(row, column, octant)
        wrong[1:] |= np.diff(key) <= 0
        if wrong.any():
            raise ValueError(f"record {int(np.flatnonzero(wrong)[0])} is out of range or out of order")
        return cls(key, slope, offset_sd)
