"""Rides of bicycle computers as tables: FIT (Garmin's binary records, by fitdecode) and TCX (XML, by expat).

A row is a record of a FIT file, or a track point of a TCX file; columns have the names of the format: ``timestamp``,
``enhanced_speed`` and ``power``, or ``Time``, ``Speed`` and ``Watts``. Units are SI in both. Other rows, laps and
devices are left out.
"""

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.parsers import expat

from estimator.can_io.logs.source import PIECE, Source
from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError, RoadloadError
from estimator.extras import how_to_install

RECORD, POINT = "record", "Trackpoint"
MAX_TEXT = 1 << 12  # characters of a value in XML, levels and kinds of values: more are none of a ride
Row = dict[str, Any]


def read_fit(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of the records of a FIT file.

    Raises
    ------
    LogError
        fitdecode is missing, or the file is damaged or cut off.
    """
    try:
        import fitdecode
    except ImportError as error:
        raise LogError(f"{path}: FIT needs fitdecode: {how_to_install('tables')}") from error
    strict = {"check_crc": fitdecode.CrcCheck.RAISE, "error_handling": fitdecode.ErrorHandling.RAISE}
    with Source(path) as source:
        try:
            with fitdecode.FitReader(source.stream, **strict) as frames:
                records = (frame for frame in frames if isinstance(frame, fitdecode.FitDataMessage))
                units = dict[str, str]()
                rows = (_record(frame, units) for frame in records if frame.name == RECORD)
                yield from _pieces(path, rows, wanted, source, units)
        except (RoadloadError, OSError, EOFError, zlib.error):  # of the table, or of the file itself
            raise
        except Exception as error:  # of any kind: fitdecode raises those of Python too
            reason = " ".join(str(error).split())[:100]
            raise LogError(f"{path}: is a damaged or cut FIT file ({reason}); copy or export it anew") from error


def _record(frame: Any, units: dict[str, str]) -> Row:
    """The values of a record; their units are added to ``units``."""
    fields = [field for field in frame.fields if field.value is not None]
    units |= {field.name: field.units for field in fields if field.units}
    return {field.name: field.value for field in fields}


def read_tcx(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of the track points of a TCX file; entities are refused, and nothing but the points is kept.

    Raises
    ------
    LogError
        The file is no XML, is cut off, or declares a document type.
    """
    with Source(path) as source:
        units = {"Speed": "m/s", "Watts": "W", "AltitudeMeters": "m"}  # of the format
        yield from _pieces(path, _points(path, source), wanted, source, units)


def _points(path: Path, source: Source) -> Iterator[Row]:
    """Track points: values by the name of their element, the first one where there are several."""
    points, parser = _Points(path), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = points.start, points.end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = points.text, points.refuse
    try:
        fed = 0
        while data := source.stream.read(PIECE):
            parser.Parse(data)
            yield from points.take()
            fed += len(data)
            if fed - parser.CurrentByteIndex > 2 * PIECE:  # the parser holds a tag until it ends
                raise LogError(f"{path}: has a tag of over {PIECE >> 20} MiB; export it anew as TCX")
        parser.Parse(b"", True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # or of an encoding that Python does not know
        raise LogError(f"{path}: is no whole XML ({error}); copy or export it anew") from error


class _Points:
    """Collects the values of a track point while its XML is parsed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._done: list[Row] = []
        self._row: Row | None = None
        self._text = ""
        self._level = 0

    def take(self) -> Sequence[Row]:
        """The points that are whole since the last call."""
        done, self._done = self._done, []
        return done

    def start(self, name: str, _: dict[str, str]) -> None:
        """An element begins."""
        self._level += 1
        if self._level > MAX_TEXT:
            raise LogError(f"{self._path}: has over {MAX_TEXT} elements in one another; export it anew as TCX")
        self._text = ""
        if _local(name) == POINT:
            self._row = {}

    def text(self, data: str) -> None:
        """A part of the text of an element."""
        if self._row is not None:
            self._text += data
        if len(self._text) > MAX_TEXT:
            raise LogError(f"{self._path}: has a value of over {MAX_TEXT} characters; export it anew as TCX")

    def end(self, name: str) -> None:
        """An element ends."""
        self._level -= 1
        if self._row is None:
            return
        if _local(name) == POINT:
            self._done.append(self._row)
            self._row = None
        elif value := self._text.strip():
            self._row.setdefault(_local(name), value)
        self._text = ""

    def refuse(self, *_: object) -> None:
        """A document type may declare entities that unpack to any size."""
        raise LogError(f"{self._path}: declares a document type, which TCX has not; take the line <!DOCTYPE ...> out")


def _local(name: str) -> str:
    """The name of an element without its prefix."""
    return name.rpartition(":")[2]


def _pieces(
    path: Path, rows: Iterator[Row], wanted: Wanted, source: Source, units: Mapping[str, str]
) -> Iterator[Piece]:
    """Rows as pieces, of the wanted values only. Columns are those that any row had so far."""
    names, chosen, part = dict[str, None](), set[str](), list[Row]()
    for row in rows:
        if not row.keys() <= names.keys():
            names |= dict.fromkeys(row)
            chosen = wanted(names)
        if len(names) > MAX_TEXT:
            raise LogError(f"{path}: has over {MAX_TEXT} kinds of values; export it anew")
        part.append({name: row[name] for name in chosen & row.keys()})
        if len(part) == ROWS:
            yield Piece(_cells(names, chosen, part), source.consumed, units)
            part = []
    if part:
        yield Piece(_cells(names, chosen, part), source.consumed, units)


def _cells(names: Iterable[str], chosen: set[str], rows: Sequence[Row]) -> Mapping[str, Any]:
    """Cells by column; a value that is missing is NaN."""
    return {name: [row.get(name, float("nan")) for row in rows] if name in chosen else () for name in names}
