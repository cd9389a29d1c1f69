"""Rides of bicycle computers as tables: FIT (Garmin's binary records, by fitdecode) and TCX (XML, by expat).

A row is a record of a FIT file, or a track point of a TCX file; columns have the names of the format: ``timestamp``,
``enhanced_speed`` and ``power``, or ``Time``, ``Speed`` and ``Watts``. Units are SI in both. Other rows, laps and
devices are left out.
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any
from xml.parsers import expat

from estimator.can_io.logs.source import PIECE, Source
from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError
from estimator.extras import how_to_install

RECORD, POINT = "record", "Trackpoint"
MAX_TEXT = 1 << 12  # characters of a value in XML, and elements of a point: more are none of a ride
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
                rows = (
                    {field.name: field.value for field in frame.fields if field.value is not None}
                    for frame in records
                    if frame.name == RECORD
                )
                yield from _pieces(rows, wanted, source)
        except (fitdecode.FitError, ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
            reason = " ".join(str(error).split())[:100]
            raise LogError(f"{path}: is a damaged or cut FIT file ({reason}); copy or export it anew") from error


def read_tcx(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of the track points of a TCX file; entities are refused, and nothing but the points is kept.

    Raises
    ------
    LogError
        The file is no XML, is cut off, or declares a document type.
    """
    with Source(path) as source:
        yield from _pieces(_points(path, source), wanted, source)


def _points(path: Path, source: Source) -> Iterator[Row]:
    """Track points: values by the name of their element, the first one where there are several."""
    points, parser = _Points(path), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = points.start, points.end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = points.text, points.refuse
    try:
        while data := source.stream.read(PIECE):
            parser.Parse(data)
            yield from points.take()
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        raise LogError(f"{path}: is no whole XML ({error}); copy or export it anew") from error


class _Points:
    """Collects the values of a track point while its XML is parsed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._done: list[Row] = []
        self._row: Row | None = None
        self._text = ""

    def take(self) -> Sequence[Row]:
        """The points that are whole since the last call."""
        done, self._done = self._done, []
        return done

    def start(self, name: str, _: dict[str, str]) -> None:
        """An element begins."""
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
        if self._row is None:
            return
        if _local(name) == POINT:
            self._done.append(self._row)
            self._row = None
        elif value := self._text.strip():
            self._row.setdefault(_local(name), value)
            if len(self._row) > MAX_TEXT:
                raise LogError(f"{self._path}: has a point of over {MAX_TEXT} values; export it anew as TCX")
        self._text = ""

    def refuse(self, *_: object) -> None:
        """A document type may declare entities that unpack to any size."""
        raise LogError(f"{self._path}: declares a document type, which TCX has not; take the line <!DOCTYPE ...> out")


def _local(name: str) -> str:
    """The name of an element without its prefix."""
    return name.rpartition(":")[2]


def _pieces(rows: Iterator[Row], wanted: Wanted, source: Source) -> Iterator[Piece]:
    """Rows as pieces; a value that is missing is NaN. Columns are those that any row had so far."""
    names = dict[str, None]()
    while part := list(islice(rows, ROWS)):
        names |= dict.fromkeys(name for row in part for name in row)
        chosen = wanted(names)
        cells = {name: [row.get(name, float("nan")) for row in part] if name in chosen else () for name in names}
        yield Piece(cells, source.consumed)
