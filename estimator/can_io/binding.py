"""Which bits of which message play which role: databases and configuration brought together, once at start."""

import logging
import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal

from estimator.can_io.frames import EXTENDED
from estimator.can_io.j1939 import pgn_of
from estimator.config import Config
from estimator.errors import ConfigError, DatabaseError
from estimator.signals import DIMENSION, STATE, Role
from estimator.units import KNOWN_UNITS, Conversion, conversion_of

logging.getLogger("cantools").setLevel(logging.ERROR)


@dataclass(frozen=True)
class BoundSignal:
    """One signal with its role: bit layout as cantools gives it, and the way to SI."""

    role: Role
    signal: Signal
    conversion: Conversion
    tangent: bool = False  # an angle that stands for a slope


@dataclass(frozen=True)
class BoundMessage:
    """One message and the signals wanted from it.

    ``key`` is a PGN where ``by_pgn``, else the arbitration id with bit 31 set for 29-bit ids.
    """

    name: str
    key: int
    by_pgn: bool
    length: int
    source: int | None  # the only source address to believe, if configured
    signals: tuple[BoundSignal, ...]
    multiplexers: tuple[Signal, ...]


def load_database(paths: list[str]) -> Database:
    """Load DBC files into one database; with none, the shipped J1939 one.

    Raises
    ------
    DatabaseError
        A file is missing or does not parse.
    """
    if not paths:
        return _parse("j1939.dbc (shipped)", files("estimator.dbc").joinpath("j1939.dbc").read_text("utf-8"))
    texts = []
    for path in paths:
        try:
            texts.append((path, Path(path).read_text("cp1252", errors="replace")))
        except OSError as error:
            raise DatabaseError(f"{path}: {error.strerror}") from error
    database = _parse(*texts[0])
    for path, text in texts[1:]:
        database.messages.extend(_parse(path, text).messages)
    database.refresh()
    return database


def _parse(path: str, text: str) -> Database:
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=False)
    except (cantools.Error, ValueError, KeyError, IndexError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise DatabaseError(f"{path}: not a DBC that can be read: {reason}") from error
    if not isinstance(database, Database) or not database.messages:
        raise DatabaseError(f"{path}: holds no CAN messages")
    return database


def bind(config: Config, database: Database) -> list[BoundMessage]:
    """Resolve every ``MESSAGE.signal`` of the configuration.

    Raises
    ------
    DatabaseError
        A message or signal is not in the database, or its unit is unknown or of the wrong kind.
    ConfigError
        ``bus.source_addresses`` names a message that nothing is bound to.
    """
    wanted: dict[str, list[BoundSignal]] = {}
    for role, bound in config.binding.items():
        for path in [bound] if isinstance(bound, str) else bound:
            message_name, signal_name = path.split(".")
            signal = _find(database, message_name, signal_name, f"signals.{role}")
            wanted.setdefault(message_name, []).append(_convert(Role(role), signal, path))
    for name in config.bus.source_addresses:
        if name not in wanted:
            raise ConfigError(f"bus.source_addresses.{name}: no signal is bound to that message")
    return [_bound(database.get_message_by_name(name), tuple(signals), config) for name, signals in wanted.items()]


def _find(database: Database, message_name: str, signal_name: str, place: str) -> Signal:
    try:
        message = database.get_message_by_name(message_name)
    except KeyError:
        raise DatabaseError(f"{place}: the DBC has no message {message_name!r}") from None
    for signal in message.signals:
        if signal.name == signal_name:
            return signal
    has = ", ".join(s.name for s in message.signals)
    raise DatabaseError(f"{place}: message {message_name!r} has no signal {signal_name!r}; it has {has}")


def _convert(role: Role, signal: Signal, path: str) -> BoundSignal:
    dimension = DIMENSION[role]
    if dimension == STATE:
        return BoundSignal(role, signal, Conversion(STATE, 1.0))
    conversion = conversion_of(signal.unit)
    if conversion is None:
        known = " ".join(u for u, c in KNOWN_UNITS.items() if c.dimension == dimension)
        raise DatabaseError(f"{path}: unknown unit {signal.unit or ''!r}; for {role} write one of: {known}")
    if role == Role.GRADE and conversion.dimension == "rad":
        return BoundSignal(role, signal, conversion, tangent=True)
    if conversion.dimension != dimension:
        raise DatabaseError(f"{path}: unit {signal.unit!r} does not fit {role}, which is in {dimension}")
    return BoundSignal(role, signal, conversion)


def _bound(message: Message, signals: tuple[BoundSignal, ...], config: Config) -> BoundMessage:
    by_pgn = config.bus.match == "pgn" or (config.bus.match == "auto" and message.protocol == "j1939")
    if by_pgn and not message.is_extended_frame:
        raise ConfigError(f"bus.match: {message.name} has an 11-bit id and cannot be matched by PGN")
    key = _pgn(message.frame_id) if by_pgn else message.frame_id | (EXTENDED if message.is_extended_frame else 0)
    parents = {s.signal.multiplexer_signal for s in signals}
    # A multiplexer may itself be multiplexed: follow the chain up.
    chain = {s.name: s for s in message.signals}
    names = {name for name in parents if name}
    while more := {chain[n].multiplexer_signal for n in names} - names - {None}:
        names |= {name for name in more if name}
    return BoundMessage(
        message.name,
        key,
        by_pgn,
        math.ceil(message.length),
        config.bus.source_addresses.get(message.name),
        signals,
        tuple(chain[name] for name in sorted(names)),
    )


def _pgn(ident: int) -> int:
    return int(pgn_of(np.array([ident], dtype=np.uint32))[0])
