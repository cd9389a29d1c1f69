"""The subcommand `init`: a configuration proposed from databases, and from a log if there is one."""

import argparse
import tomllib
from pathlib import Path
from shlex import quote

from estimator.can_io.binding import load_database
from estimator.can_io.role_candidates import candidates
from estimator.commands.arguments import add_debug
from estimator.commands.complaints import complain
from estimator.commands.terminal import progress_bar
from estimator.config import Config, from_dict
from estimator.errors import ConfigError
from estimator.output_files import check_suffix, whole
from estimator.report.proposal import battery, proposal
from estimator.signals import Role
from estimator.streaming.discharge_sign import Sign, discharge_sign
from estimator.streaming.survey import survey

DATABASE = ".dbc"
FORMATS = (".toml",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    use = "databases of the vehicle (.dbc), and a log that shows which of their signals come"
    parser.add_argument("file", nargs="+", type=Path, metavar="FILE.dbc [LOG]", help=use)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.toml", help="a new file, instead of standard output")
    add_debug(parser)


def run(options: argparse.Namespace) -> int:
    """Propose a configuration.

    Raises
    ------
    ConfigError
        No database is given, more than one log is, nothing of it comes in the log, or the output exists.
    """
    databases, log = _inputs(options.file)
    output: Path | None = options.output
    if output is not None:
        check_suffix(output, FORMATS)
        if output.exists():
            raise ConfigError(f"{output}: exists; give another name, or remove it first")
    database = load_database([str(path) for path in databases])
    by_role = candidates(database)
    found = None
    if log is not None:
        with progress_bar("reading") as progress:
            found = survey(log, [candidate for fit in by_role.values() for candidate in fit], progress)
        if by_role and not found.presences and not found.is_by_group:
            names = ", ".join(map(str, databases))
            raise ConfigError(f"{log}: nothing of {names} that is of use comes in it; is it of this vehicle?")
    text = proposal(databases, by_role, found, log)
    config = from_dict(tomllib.loads(text))
    if Role.BATTERY_CURRENT in config.signals:
        text += battery(None if log is None else _sign(log, config))
    for remark in database.remarks:
        complain(f"note: {remark}")
    if output is None:
        print(text, end="")
        return 0
    with whole(output) as file:
        file.write(text.encode())
    shown = f"roadload check {quote(str(log or 'LOG'))} --config {quote(str(output))}"
    complain(f"note: {output} is written; look at its signals, then run {shown}")
    return 0


def _sign(log: Path, config: Config) -> Sign | None:
    with progress_bar("current") as progress:
        return discharge_sign(log, config, progress)


def _inputs(files: list[Path]) -> tuple[list[Path], Path | None]:
    """Databases, and the log if there is one."""
    databases = [path for path in files if path.suffix.lower() == DATABASE]
    logs = [path for path in files if path not in databases]
    if not databases:
        raise ConfigError(f"{files[0]}: is no {DATABASE} file; give the database of the vehicle first, then a log")
    if len(logs) > 1:
        raise ConfigError(f"{logs[1]}: is a second log; give one")
    return databases, logs[0] if logs else None
