"""Binding of roles to signals of messages, from databases and configuration, once at start."""

import logging
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal

from estimator.can_io.database_limits import read_databases
from estimator.can_io.database_mending import ORIGINAL_NAME, mend, mended_name
from estimator.can_io.frames import EXTENDED, JOINED_BYTES
from estimator.can_io.j1939 import pgn_of
from estimator.can_io.obd import is_answer
from estimator.can_io.switch_states import SWITCHES, States, configured, states_of
from estimator.config import Config, check_paths
from estimator.errors import ConfigError, DatabaseError
from estimator.near_names import did_you_mean, nearest
from estimator.roles import GRADES
from estimator.signals import DIMENSION, STATE, Role
from estimator.units import Conversion, conversion_of, spellings_of

logging.getLogger("cantools").setLevel(logging.ERROR)

MAX_SIGNAL_BITS = 64  # bits of a signal: the widest word that the decoder extracts
FLOATS = (16, 32, 64)  # bits of a floating-point signal
MAX_REASON = 200  # characters of what cantools says, which may quote a whole line


@dataclass(frozen=True, kw_only=True)
class BoundSignal:
    """Signal with its role, its bit layout as cantools gives it, and its conversion to SI."""

    role: Role
    signal: Signal
    conversion: Conversion
    multiplexers: tuple[Signal, ...]  # its own first, then that one's, and so on up
    tangent: bool = False  # an angle that stands for a slope
    place: int = 0  # among the signals of a role that takes several
    states: States | None = None  # of a switch whose values are not 0 off and 1 on


@dataclass(frozen=True, kw_only=True)
class BoundMessage:
    """Message and the signals that are read from it.

    ``key`` is a PGN if ``by_pgn``, else the arbitration id with bit 31 set for 29-bit ids. If ``j1939``, the highest
    raw values are not valid. ``of_any_ecu``: the answer of any ECU to OBD-II requests (ISO 15765-4).
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
        """True if the last byte of its ids is the address of the sender."""
        return self.by_pgn or self.of_any_ecu


def last_byte(signal: Signal) -> int:
    """Number of payload bytes that a frame needs to carry the whole signal."""
    if signal.byte_order == "little_endian":
        return (signal.start + signal.length + 7) // 8
    first, bit = divmod(signal.start, 8)
    return first + (7 - bit + signal.length + 7) // 8


class VehicleDatabase(Database):
    """Messages of DBC files; ``remarks`` has one line for each file in which statements were left out or changed."""

    remarks: tuple[str, ...] = ()


def load_database(paths: list[str]) -> VehicleDatabase:
    """Load DBC files into one database; without any, the shipped J1939 database.

    Raises
    ------
    DatabaseError
        A file is missing or does not parse.
    """
    messages: list[Message] = []
    remarks = []
    for path, text in _texts(paths):
        more, remark = _parse(path, text)
        for name in sorted({m.name for m in more} & {m.name for m in messages}):
            raise DatabaseError(f"{path}: message {name!r} is in another of the databases too; give one of them")
        messages.extend(more)
        remarks += [f"{path}: {remark}"] if remark else []
    database = VehicleDatabase(messages, strict=False)
    database.remarks = tuple(remarks)
    return database


def _texts(paths: list[str]) -> Iterator[tuple[str, str]]:
    if paths:
        return read_databases(paths)
    return iter([("j1939.dbc (shipped)", files("estimator.dbc").joinpath("j1939.dbc").read_text("utf-8"))])


@lru_cache(maxsize=8)  # a command asks for them several times
def _parse(path: str, text: str) -> tuple[tuple[Message, ...], str]:
    """Messages of a DBC, and the remark on its mended statements."""
    mended = mend(text)
    if not mended.statements:
        raise DatabaseError(f"{path}: not a DBC that can be read: no line of it is a statement of one")
    try:
        database = cantools.database.load_string(mended.text, database_format="dbc", strict=False)
    except (cantools.Error, ArithmeticError, ValueError, KeyError, IndexError, AttributeError) as error:
        reason = " ".join(str(error).split())[:MAX_REASON]
        raise DatabaseError(f"{path}: not a DBC that can be read: {reason}") from error
    if not isinstance(database, Database) or not database.messages:
        raise DatabaseError(f"{path}: holds no CAN messages{f'; {mended.remark}' if mended.remark else ''}")
    return tuple(database.messages), mended.remark


def bind(config: Config, database: Database) -> list[BoundMessage]:
    """Resolve every ``MESSAGE.signal`` of the configuration.

    Raises
    ------
    DatabaseError
        A message or signal is not in the database, or units are unknown or of the wrong kind.
    ConfigError
        ``bus.match``, ``bus.source_addresses`` or ``bus.states`` does not fit a message or signal, or names of ``bus``
        are not bound.
    """
    bus = config.bus
    for key, named in (("units", bus.units), ("ranges", bus.ranges), ("states", bus.states)):
        check_paths(f"bus.{key}", named, config.binding)  # here, as those of a table are not in its file
    wanted: dict[str, list[BoundSignal]] = {}
    wrong_units: dict[str, str] = {}  # complaint by MESSAGE.signal
    remedies: dict[str, str] = {}
    for role, bound in config.binding.items():
        for number, path in enumerate([bound] if isinstance(bound, str) else bound):
            message, signal = _find(database, path, f"signals.{role}")
            conversion, tangent = Conversion(DIMENSION[Role(role)], 1.0), False
            if conversion.dimension != STATE:
                unit = config.bus.units.get(path, signal.unit)
                if isinstance(read := _conversion(Role(role), unit), str):
                    wrong_units[path] = f"{path} {read}"
                    remedies[path] = spellings_of(DIMENSION[Role(role)])[0]
                else:
                    conversion, tangent = read
            _check_layout(signal, path)
            if path in config.bus.ranges:
                signal = copy(signal)
                signal.minimum, signal.maximum = config.bus.ranges[path]
            wanted.setdefault(message.name, []).append(
                BoundSignal(
                    role=Role(role),
                    signal=signal,
                    conversion=conversion,
                    multiplexers=_multiplexers(signal, message, path),
                    tangent=tangent,
                    place=number,
                    states=_states(Role(role), signal, path, config),
                )
            )
    if wrong_units:
        line = ", ".join(f'"{path}" = "{unit}"' for path, unit in remedies.items())
        raise DatabaseError(
            f"bus.units: {'; '.join(wrong_units.values())}. Write the right {'one' if len(remedies) == 1 else 'ones'} "
            f"into the configuration, for example [bus] units = {{ {line} }}"
        )
    for name in config.bus.source_addresses:
        if name not in wanted:
            raise ConfigError(
                f"bus.source_addresses.{name}: no signal is bound to that message; bound are {', '.join(wanted)}"
            )
    return [
        bound_message(database.get_message_by_name(name), tuple(signals), config) for name, signals in wanted.items()
    ]


def _find(database: Database, path: str, setting: str) -> tuple[Message, Signal]:
    """Message and signal of a ``MESSAGE.signal``, by their names in the database or in the file."""
    message_name, signal_name = path.split(".")
    messages = [message for message in database.messages if _is_called(message, message_name)]
    remarks = database.remarks if isinstance(database, VehicleDatabase) else ()
    left_out = "".join(f"; {remark}" for remark in remarks)
    if not messages:
        near = ", ".join(nearest(message_name, [message.name for message in database.messages])) or "none"
        raise DatabaseError(
            f"{setting}: the DBC has no message {message_name!r}; the nearest are {near}; roadload init proposes "
            f"signals of a database{left_out}"
        )
    if len(messages) > 1:
        raise DatabaseError(f"{setting}: the DBC has more than one message {message_name!r}; leave one of them in it")
    message = messages[0]
    for signal in message.signals:
        if _is_called(signal, signal_name):
            return message, signal
    guess = did_you_mean(signal_name, [signal.name for signal in message.signals])
    has = guess or f"; it has {', '.join(signal.name for signal in message.signals) or 'none'}"
    raise DatabaseError(f"{setting}: message {message_name!r} has no signal {signal_name!r}{has}{left_out}")


def _is_called(named: Message | Signal, name: str) -> bool:
    """True if a message or signal has this name in the database, or in the file before it was mended or shortened."""
    attributes = named.dbc.attributes if named.dbc is not None else {}
    original = attributes[ORIGINAL_NAME].value if ORIGINAL_NAME in attributes else None
    return name in (named.name, original) or mended_name(name) == named.name


def _conversion(role: Role, unit: str | None) -> tuple[Conversion, bool] | str:
    """Conversion to SI and whether a slope is given as an angle; or, as text, the error of the unit."""
    conversion, dimension = conversion_of(unit), DIMENSION[role]
    accepted = f"{role} takes {' '.join(spellings_of(dimension))}"
    if conversion is None:
        return (
            f"has no unit ({accepted})" if not (unit or "").strip() else f"has the unknown unit {unit!r} ({accepted})"
        )
    tangent = role in GRADES and conversion.dimension == "rad"
    if conversion.dimension != dimension and not tangent:
        return f"has the unit {unit!r}, which does not fit ({accepted})"
    return conversion, tangent


def _states(role: Role, signal: Signal, path: str, config: Config) -> States | None:
    """Values of a switch that mean on; None if its values are used unchanged: 0 off, 1 on."""
    raw = config.bus.states.get(path)
    choices: Mapping[int, object] = signal.choices or {}
    scale, offset = float(signal.scale), float(signal.offset)
    if role not in SWITCHES:
        if raw is not None:
            raise ConfigError(f"bus.states.{path}: {role} is no switch; take it out")
        return None
    if raw is not None:
        return configured(raw, choices, scale, offset)
    return states_of(choices, scale, offset, is_clutch=role == Role.CLUTCH_SWITCH)


def _check_layout(signal: Signal, path: str) -> None:
    if signal.length > MAX_SIGNAL_BITS or (signal.is_float and signal.length not in FLOATS):
        kind = "floating-point signal" if signal.is_float else "signal"
        raise DatabaseError(f"{path}: a {kind} of {signal.length} bits is no number; correct the DBC")
    if last_byte(signal) > JOINED_BYTES:
        raise DatabaseError(f"{path}: lies beyond byte {JOINED_BYTES} of its message; correct the DBC")
    if signal.scale == 0:
        raise DatabaseError(f"{path}: has a factor of 0; correct the DBC")


def _multiplexers(signal: Signal, message: Message, path: str) -> tuple[Signal, ...]:
    by_name = {s.name: s for s in message.signals}
    chain: list[Signal] = []
    while signal.multiplexer_signal:
        signal = by_name[signal.multiplexer_signal]
        if signal in chain:
            raise DatabaseError(f"{path}: {signal.name} multiplexes itself; correct the DBC")
        chain.append(signal)
    return tuple(chain)


def bound_message(message: Message, signals: tuple[BoundSignal, ...], config: Config) -> BoundMessage:
    """Bind ``signals`` of a message, which is matched as the configuration says.

    Raises
    ------
    ConfigError
        ``bus.match`` or ``bus.source_addresses`` does not fit the message.
    """
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
