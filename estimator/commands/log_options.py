"""Options of the subcommands that read logs."""

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from estimator import config
from estimator.can_io.binding import load_database
from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.database_limits import require_files
from estimator.can_io.logs import FORMATS
from estimator.can_io.logs.channels import described
from estimator.commands.arguments import positive, whole_number
from estimator.commands.complaints import complain
from estimator.config import Config
from estimator.errors import ConfigError
from estimator.model.effects import CATALOGUE, named
from estimator.output_files import check_suffix
from estimator.settings import Table

RECORDED = f"recorded traffic: {' '.join(FORMATS)}"


def add_seed(parser: argparse.ArgumentParser, use: str) -> None:
    """Add --seed of the ``use``."""
    parser.add_argument("--seed", type=whole_number, help=f"of the {use}, instead of the configuration's")


def add_channels(parser: argparse.ArgumentParser) -> None:
    """Add --channel."""
    text = "of a log with several, as the log names it: 1, can0; may be repeated"
    parser.add_argument("--channel", action="append", default=[], dest="channels", metavar="NAME", help=text)


def speed_of(text: str) -> float | None:
    """Multiple of real time at which a log is played; None for "max".

    Raises
    ------
    ConfigError
        It is neither "max" nor a positive factor.
    """
    if text == "max":
        return None
    try:
        return positive(text)
    except argparse.ArgumentTypeError as error:
        raise ConfigError(f"--speed: {text!r} is neither 'max' nor a positive factor") from error


def complain_of_channels(counts: Mapping[str, int]) -> None:
    """A note on logs whose channels were read as one bus, with their frames by channel, if there are such."""
    if counts:
        complain(f"note: {described(counts)} are read as one bus; choose with --channel")


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add --map."""
    text = 'a column of a table, for tables instead of logs: speed="v [km/h]", power="P [kW]", time="t [s]"; repeated'
    parser.add_argument("--map", action="append", default=[], metavar='ROLE="COLUMN [unit]"', help=text)


def table_of(given: Table | None, mappings: Sequence[str]) -> Table | None:
    """The table of the configuration, with the columns of --map; a second one of a role is its alternative."""
    if not mappings:
        return given
    mapped = dict[str, list[str]]()
    for mapping in mappings:
        role, sign, column = (part.strip() for part in mapping.partition("="))
        if not sign:
            raise ConfigError(f'--map {mapping}: write ROLE="COLUMN [unit]", as in --map speed="v [km/h]"')
        mapped.setdefault(role, []).append(column)
    before = given or Table()
    columns = {role: texts[0] for role, texts in mapped.items()}
    time = columns.pop("time", before.time)
    alternatives = {role: texts for role, texts in before.alternatives.items() if role not in mapped}
    alternatives |= {role: texts[1:] for role, texts in mapped.items() if len(texts) > 1}
    return Table(time=time, columns={**before.columns, **columns}, alternatives=alternatives)


def complain_of_databases(settings: Config) -> None:
    """A note on each database of which something was left out or changed."""
    for remark in load_database(settings.bus.dbc).remarks:
        complain(f"note: {remark}")


def add_effects(parser: argparse.ArgumentParser) -> None:
    """Add --effect."""
    names = ", ".join(effect.name for effect in CATALOGUE if effect.is_streaming)
    text = f"an effect to add to the model; may be repeated: {names}"
    parser.add_argument("--effect", action="append", default=[], metavar="NAME", help=text)


def check_outputs(logs: Sequence[Path], outputs: Mapping[Path | None, tuple[str, ...]]) -> None:
    """Refuse outputs of an unknown format, and those that would overwrite an input, before the work is done.

    Raises
    ------
    ConfigError
        The message names the file.
    """
    inputs = {os.path.realpath(path) for path in logs}  # of links that lead in a circle, too
    for path, formats in outputs.items():
        if path is not None:
            check_suffix(path, formats)
            if os.path.realpath(path) in inputs:
                raise ConfigError(f"{path}: is an input; write to another file")


def settings(options: argparse.Namespace) -> Config:
    """The configuration file, with --dbc, --channel, --effect and --seed in its place.

    Raises
    ------
    ConfigError, DatabaseError
        The file or an option is wrong, or does not fit the databases; the message names the file and the key.
    """
    found = config.load(options.config)
    with config.in_file(options.config):
        named(found.effects)
    if options.dbc:
        found = config.replace(found, bus=msgspec.structs.replace(found.bus, dbc=options.dbc))
    if getattr(options, "channels", None):
        found = config.replace(found, bus=msgspec.structs.replace(found.bus, channels=options.channels))
    if getattr(options, "map", None):
        found = config.replace(found, table=table_of(found.table, options.map))
    if getattr(options, "effect", None):
        found = msgspec.structs.replace(found, effects=[*found.effects, *options.effect])
    if getattr(options, "seed", None) is not None:
        found = config.replace(found, sampler=msgspec.structs.replace(found.sampler, seed=options.seed))
    config.check(found)
    with config.in_file(None if options.dbc else options.config):
        require_files(found.bus.dbc)
    if found.table is None:
        with config.in_file(options.config):
            bound_messages(found)
    return found
