"""Binding of roles to signals of messages, from databases and configuration, once at start."""

import difflib
import logging
from dataclasses import dataclass, replace
from importlib.resources import files

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal

from estimator.can_io.database_limits import read_databases
from estimator.can_io.frames import EXTENDED, JOINED_BYTES
from estimator.can_io.j1939 import pgn_of
from estimator.can_io.obd import is_answer
from estimator.config import Config
from estimator.errors import ConfigError, DatabaseError
from estimator.signals import DIMENSION, STATE, Role
from estimator.units import KNOWN_UNITS, Conversion, conversion_of

logging.getLogger("cantools").setLevel(logging.ERROR)

MAX_SIGNAL_BITS = 64  # bits of a signal: the widest word that the decoder extracts
FLOATS = (16, 32, 64)  # bits of a floating-point signal
MAX_REASON = 200  # characters of what cantools says, which may quote a whole line


@dataclass(frozen=True, kw_only=True)
class BoundSignal:
    """One signal with its role: bit layout as cantools gives it, and the way to SI."""

    role: Role
    signal: Signal
    conversion: Conversion
    multiplexers: tuple[Signal, ...]  # its own first, then that one's, and so on up
    tangent: bool = False  # an angle that stands for a slope
    place: int = 0  # among the signals of a role that takes several


@dataclass(frozen=True, kw_only=True)
class BoundMessage:
    """One message and the signals wanted from it.

    ``key`` is a PGN where ``by_pgn``, else the arbitration id with bit 31 set for 29-bit ids. Where ``j1939``, the
    highest raw values are no values. ``of_any_ecu``: the answer of any ECU to OBD-II requests (ISO 15765-4).
    """

    name: str
    key: int
    by_pgn: bool
    j1939: bool
    source: int | None  # the only source address that is accepted, if configured
    cycle: float | None  # s between two of them by the database; None if it has none
    length: int  # bytes by the database
    signals: tuple[BoundSignal, ...]
    of_any_ecu: bool = False

    @property
    def names_sender(self) -> bool:
        """Whether the last byte of its ids is the address of the sender."""
        return self.by_pgn or self.of_any_ecu


def last_byte(signal: Signal) -> int:
    """Number of payload bytes that a frame needs to carry the whole signal."""
    if signal.byte_order == "little_endian":
        return (signal.start + signal.length + 7) // 8
    first, bit = divmod(signal.start, 8)
    return first + (7 - bit + signal.length + 7) // 8


def load_database(paths: list[str]) -> Database:
    """Load DBC files into one database; with none, the shipped J1939 one.

    Raises
    ------
    DatabaseError
        A file is missing or does not parse.
    """
    if not paths:
        return _parse("j1939.dbc (shipped)", files("estimator.dbc").joinpath("j1939.dbc").read_text("utf-8"))
    texts = read_databases(paths)
    database = _parse(*next(texts))
    for path, text in texts:
        more = _parse(path, text).messages
        for name in sorted({m.name for m in more} & {m.name for m in database.messages}):
            raise DatabaseError(f"{path}: message {name!r} is in another of the databases too; give one of them")
        database.messages.extend(more)
    database.refresh()
    return database


def _parse(path: str, text: str) -> Database:
    try:
        database = cantools.database.load_string(text, database_format="dbc", strict=False)
    except (cantools.Error, ValueError, KeyError, IndexError, AttributeError) as error:
        reason = " ".join(str(error).split())[:MAX_REASON]
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
        ``bus.match`` or ``bus.source_addresses`` does not fit a message.
    """
    wanted: dict[str, list[BoundSignal]] = {}
    for role, bound in config.binding.items():
        for place, path in enumerate([bound] if isinstance(bound, str) else bound):
            message_name, signal_name = path.split(".")
            message, signal = _find(database, message_name, signal_name, f"signals.{role}")
            converted = replace(_convert(Role(role), signal, message, path), place=place)
            wanted.setdefault(message_name, []).append(converted)
    for name in config.bus.source_addresses:
        if name not in wanted:
            has = ", ".join(wanted)
            raise ConfigError(f"bus.source_addresses.{name}: no signal is bound to that message; bound are {has}")
    return [_bound(database.get_message_by_name(name), tuple(signals), config) for name, signals in wanted.items()]


def _find(database: Database, message_name: str, signal_name: str, place: str) -> tuple[Message, Signal]:
    try:
        message = database.get_message_by_name(message_name)
    except KeyError:
        near = ", ".join(difflib.get_close_matches(message_name, [m.name for m in database.messages], cutoff=0))
        raise DatabaseError(f"{place}: the DBC has no message {message_name!r}; the nearest are {near}") from None
    if sum(other.name == message_name for other in database.messages) > 1:
        raise DatabaseError(f"{place}: the DBC has more than one message {message_name!r}; leave one of them in it")
    for signal in message.signals:
        if signal.name == signal_name:
            return message, signal
    has = ", ".join(s.name for s in message.signals)
    raise DatabaseError(f"{place}: message {message_name!r} has no signal {signal_name!r}; it has {has}")


def _convert(role: Role, signal: Signal, message: Message, path: str) -> BoundSignal:
    if signal.length > MAX_SIGNAL_BITS or (signal.is_float and signal.length not in FLOATS):
        kind = "floating-point signal" if signal.is_float else "signal"
        raise DatabaseError(f"{path}: a {kind} of {signal.length} bits is no number; correct the DBC")
    if last_byte(signal) > JOINED_BYTES:
        raise DatabaseError(f"{path}: lies beyond byte {JOINED_BYTES} of its message; correct the DBC")
    if signal.scale == 0:
        raise DatabaseError(f"{path}: has a factor of 0; correct the DBC")
    multiplexers = _multiplexers(signal, message, path)
    dimension = DIMENSION[role]
    if dimension == STATE:
        return BoundSignal(role=role, signal=signal, conversion=Conversion(STATE, 1.0), multiplexers=multiplexers)
    conversion = conversion_of(signal.unit)
    known = " ".join(u for u, c in KNOWN_UNITS.items() if c.dimension == dimension)
    if conversion is None:
        raise DatabaseError(f"{path}: unknown unit {signal.unit or ''!r}; for {role} write one of: {known}")
    tangent = role == Role.GRADE and conversion.dimension == "rad"
    if conversion.dimension != dimension and not tangent:
        raise DatabaseError(f"{path}: unit {signal.unit!r} does not fit {role}, which takes one of: {known}")
    return BoundSignal(role=role, signal=signal, conversion=conversion, multiplexers=multiplexers, tangent=tangent)


def _multiplexers(signal: Signal, message: Message, path: str) -> tuple[Signal, ...]:
    by_name = {s.name: s for s in message.signals}
    chain: list[Signal] = []
    while signal.multiplexer_signal:
        signal = by_name[signal.multiplexer_signal]
        if signal in chain:
            raise DatabaseError(f"{path}: {signal.name} multiplexes itself; correct the DBC")
        chain.append(signal)
    return tuple(chain)


def _bound(message: Message, signals: tuple[BoundSignal, ...], config: Config) -> BoundMessage:
    match, name, extended = config.bus.match, message.name, message.is_extended_frame
    if match == "pgn" and not extended:
        raise ConfigError(f'bus.match: {name} has an 11-bit id, which holds no PGN; write "auto" or "id"')
    j1939 = extended and (match == "pgn" or message.protocol == "j1939")
    by_pgn = j1939 and match != "id"
    whole = message.frame_id | (EXTENDED if extended else 0)
    of_any_ecu = match == "obd" and bool(is_answer(np.array([whole], np.uint32))[0])
    source = config.bus.source_addresses.get(name)
    if source is not None and not by_pgn and not of_any_ecu:
        raise ConfigError(f"bus.source_addresses.{name}: matched by its whole id, not by PGN; leave it out")
    key = _pgn(message.frame_id) if by_pgn else whole
    period: object = message.cycle_time  # [ms]; an attribute of the database may be of any type
    cycle = period / 1000 if isinstance(period, int | float) and period > 0 else None
    return BoundMessage(
        name=name,
        key=key,
        by_pgn=by_pgn,
        j1939=j1939,
        source=source,
        cycle=cycle,
        length=message.length,
        signals=signals,
        of_any_ecu=of_any_ecu,
    )


def _pgn(ident: int) -> int:
    return int(pgn_of(np.array([ident], dtype=np.uint32))[0])
