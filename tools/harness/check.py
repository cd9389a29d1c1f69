"""A check: a command line, figures as data, and tables that are made of these figures alone.

``python tools/check_NAME.py`` prints the tables as Markdown. ``--json`` prints the figures with the program's version
and the options, which hold the seed; ``--out`` writes the same to results/NAME.json, of which `results_pages.py` makes
a page. The same version, options and libraries give the same bytes. ``--read FILE`` makes the tables of figures that
were written before.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

from estimator import __version__
from estimator.errors import InputError, RoadloadError
from estimator.output_files import whole

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
NOTHING = "-"  # a cell without a value
OWN = ("json", "out", "read", "date", "workers")  # options that change no figure
Figures = dict[str, Any]
Item = TypeVar("Item")


@dataclass(frozen=True)
class Table:
    """Rows of cells (n, columns) as text, under a title that may be empty."""

    title: str
    columns: tuple[str, ...]
    rows: list[list[str]]

    @classmethod
    def of(cls, title: str, records: list[dict[str, Any]]) -> "Table":
        """Records of the same keys, which are the columns; their values as `cell` shows them."""
        columns = tuple(records[0]) if records else ()
        return cls(title, columns, [[cell(value) for value in record.values()] for record in records])

    def markdown(self) -> str:
        """The table as Markdown, under a heading of its title."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        text = "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
        return f"## {self.title}\n\n{text}\n" if self.title else f"{text}\n"


@dataclass(frozen=True)
class Cells:
    """The most important cells of a check: in ``columns`` of the rows whose first cell begins with one of ``rows``.

    All columns if none are named; ``table`` is the title of the table, else the first.
    """

    rows: tuple[str, ...] = ("",)
    columns: tuple[str, ...] = ()
    table: str = ""

    def text(self, tables: Sequence[Table]) -> str:
        """The cells with the names of their rows and columns."""
        table = next((each for each in tables if not self.table or each.title == self.table), Table("", (), []))
        lines = []
        for name, *cells in table.rows:
            named = zip(table.columns[1:], cells, strict=True)
            wanted = self.columns or table.columns
            shown = [(column, cell) for column, cell in named if column in wanted and cell != NOTHING]
            chosen = [cell if column == "value" else f"{column} {cell}" for column, cell in shown]
            lines += [f"**{name}**: {', '.join(chosen)}"] if name.startswith(self.rows) else []
        return "; ".join(lines)


@dataclass(frozen=True, kw_only=True)
class Check:
    """A check; the module of ``measure`` gives its name and, by its docstring, its help and the text of its page.

    ``measure`` takes the options to figures, ``tables`` shows figures, ``headline`` chooses the most important cells,
    and ``fails`` says whether the exit status is 1. ``first``: arguments that the command begins with. ``part``: name
    of a further check of a module.
    """

    title: str
    measure: Callable[[argparse.Namespace], Figures]
    tables: Callable[[Figures], list[Table]]
    headline: Cells
    options: Callable[[argparse.ArgumentParser], None]
    fails: Callable[[Figures], bool] = lambda figures: False
    first: str = ""
    part: str = ""

    @property
    def about(self) -> str:
        """What is measured, and how."""
        return sys.modules[self.measure.__module__].__doc__ or ""

    @property
    def program(self) -> Path:
        """The file that is run."""
        return Path(sys.modules[self.measure.__module__].__file__ or "").resolve()

    @property
    def name(self) -> str:
        """Name of the record: that of the module, and of the part."""
        return "_".join(filter(None, (self.program.stem.removeprefix("check_"), self.part)))

    def main(self, arguments: list[str] | None = None) -> int:
        """Measure, or read what was measured; print and write the figures."""
        options = self.parser().parse_args(arguments)
        try:
            record = read_record(options.read) if options.read else self.record(options)
            text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
            if options.out:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                with whole(options.out) as file:
                    file.write(text.encode())
        except (RoadloadError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            return error.exit_status if isinstance(error, RoadloadError) else 2
        tables = self.tables(record["figures"])
        print(text if options.json else "\n".join(table.markdown() for table in tables), end="")
        return int(self.fails(record["figures"]))

    def record(self, options: argparse.Namespace) -> dict[str, Any]:
        """What is written: figures, version, and the options that made them."""
        chosen = {name: value for name, value in vars(options).items() if name not in OWN and not _is_place(value)}
        dated = {"date": options.date} if options.date else {}
        figures = self.measure(options)
        return {"check": self.name, "version": __version__, **dated, "options": chosen, "figures": plain(figures)}

    def command(self, options: dict[str, Any]) -> str:
        """The command line that measures with the ``options`` of a record."""
        parser, words = self.parser(), [self.program.relative_to(ROOT).as_posix(), *self.first.split()]
        for name, value in options.items():
            if value != parser.get_default(name):
                values = value if isinstance(value, list) else [] if value is True else [value]
                numbers = (f"{each:g}" if isinstance(each, float) else str(each) for each in values)
                words += [f"--{name.replace('_', '-')}", *numbers]
        return shlex.join(["python", *words])

    def parser(self) -> argparse.ArgumentParser:
        """Options of this check, and those of every check."""
        parser = argparse.ArgumentParser(description=self.about, formatter_class=argparse.RawDescriptionHelpFormatter)
        self.options(parser)
        place = RESULTS / f"{self.name}.json"
        parser.add_argument("--json", action="store_true", help="print the figures")
        written = f"write the figures; without a name to {place.relative_to(ROOT)}"
        parser.add_argument("--out", type=Path, nargs="?", const=place, metavar="FILE", help=written)
        parser.add_argument("--read", type=Path, metavar="FILE", help="measure nothing: show these figures")
        parser.add_argument("--date", help="is written beside the figures")
        return parser


def read_record(path: Path) -> dict[str, Any]:
    """What a check wrote.

    Raises
    ------
    InputError
        The file is missing, or holds no figures.
    """
    try:
        record: dict[str, Any] = json.loads(path.read_bytes())
        return record | {"figures": record["figures"]}
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; check the path") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: holds no figures of a check; give a file that --out has written") from error


def drive_options(drives: int, minutes: float, seed: int = 1) -> Callable[[argparse.ArgumentParser], None]:
    """What adds options for the number of drives, their length and the seed."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--drives", type=int, default=drives, help="default: %(default)s")
        parser.add_argument("--minutes", type=float, default=minutes, help="of each drive; default: %(default)g")
        parser.add_argument("--seed", type=int, default=seed, help="default: %(default)s")

    return add


def progress(items: Iterable[Item], doing: str, total: int | None = None) -> Iterable[Item]:
    """The items, with a bar on the standard error output where that is a terminal."""
    disable = not sys.stderr.isatty()
    return track(items, doing, total=total, console=Console(stderr=True), transient=True, disable=disable)


def plain(value: Any) -> Any:
    """The value as JSON can say it: numbers of Python, lists, and null for what is not finite."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not isfinite(value) else value


def percent(value: float | None, digits: int = 1, sign: str = "") -> str:
    """A share in per cent; NOTHING where there is none."""
    return NOTHING if value is None else f"{100 * value:{sign}.{digits}f} %"


def cell(value: Any) -> str:
    """Text as it is, a number, a value with its sd (2,), or a value with the ends of an interval (3,)."""
    if isinstance(value, list | tuple):
        first, *others = (cell(number) for number in value)
        return f"{first} +- {others[0]}" if len(others) == 1 else f"{first} ({' .. '.join(others)})"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return NOTHING if value is None or value == "" else str(value)


def _is_place(value: Any) -> bool:
    return isinstance(value, Path) or (isinstance(value, list) and any(isinstance(each, Path) for each in value))
