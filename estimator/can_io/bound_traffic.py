"""Messages that the configuration binds: those of databases, of a table, or of a lake of decoded signals.

Decoded signals are processed as frames: each row of a lake is a frame of 64-bit numbers. Senders, times and values are
so judged as those of a bus. Their raw values, resolution and rates are unknown.
"""

from dataclasses import replace

import msgspec
from cantools.database import Message as AnyMessage
from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion

from estimator.can_io.binding import BoundMessage, bind, load_database
from estimator.can_io.frames import FD_BYTES
from estimator.can_io.table_columns import FIRST_IDENT, FORCE, NUMBER_BYTES, POWER, binding_of, database_of
from estimator.config import Config
from estimator.errors import ConfigError

MAX_MESSAGES = 256  # of these groups


def bound_messages(config: Config) -> list[BoundMessage]:
    """Messages and signals that roles are bound to.

    Raises
    ------
    DatabaseError
        A message or signal is not known, or its unit is unknown or of the wrong kind.
    ConfigError
        ``bus.match`` or ``bus.source_addresses`` does not fit a message, a lake's signals are too many, or a driveline
        is given beside a power at the wheels.
    """
    if config.table is not None:
        at_wheels = sorted({POWER, FORCE} & config.table.columns.keys())
        if at_wheels and config.vehicle.driveline_efficiency < 1:
            raise ConfigError(
                f"vehicle.driveline_efficiency: the table's {at_wheels[0]} is that at the wheels; take the key out, or "
                "give a power at the crank as engine_power"
            )
        signals = dict(binding_of(config.table))
        bound = bind(msgspec.structs.replace(config, signals=signals, table=None), database_of(config.table))
        return [replace(message, j1939=False, cycle=None) for message in bound]
    database = load_database(config.bus.dbc)
    if config.lake is None:
        return bind(config, database)
    # Neither special values nor rates of J1939 are looked for in numbers that another program decoded.
    return [replace(message, j1939=False, cycle=None) for message in bind(config, _lake_database(config, database))]


def _lake_database(config: Config, database: Database) -> Database:
    """Database of the bound messages, with each signal as a 64-bit number."""
    names: dict[str, list[str]] = {}
    for bound in config.binding.values():
        for path in [bound] if isinstance(bound, str) else bound:
            message, signal = path.split(".")
            if signal not in names.setdefault(message, []):
                names[message].append(signal)
    if len(names) > MAX_MESSAGES:
        raise ConfigError(f"signals: of {len(names)} messages; a lake can be read for {MAX_MESSAGES}")
    return Database([_message(i, name, signals, config, database) for i, (name, signals) in enumerate(names.items())])


def _message(index: int, name: str, signals: list[str], config: Config, database: Database) -> Message:
    if len(signals) * NUMBER_BYTES > FD_BYTES:
        raise ConfigError(f"signals: {len(signals)} of {name}; of one message a lake can be read for {FD_BYTES // 8}")
    return Message(
        frame_id=FIRST_IDENT | index << 8,
        name=name,
        length=NUMBER_BYTES * len(signals),
        signals=[_signal(number, f"{name}.{signal}", config, database) for number, signal in enumerate(signals)],
        is_extended_frame=True,
        is_fd=len(signals) > 1,
        protocol="j1939",  # so that the last byte of an id is its sender
    )


def _signal(number: int, path: str, config: Config, database: Database) -> Signal:
    lake = config.lake
    assert lake is not None
    like = _signal_in(database, path)
    unit = lake.units.get(path, None if like is None else like.unit)
    low, high = lake.ranges.get(path, (None, None) if like is None else (like.minimum, like.maximum))
    return Signal(
        name=path.split(".")[1],
        start=8 * NUMBER_BYTES * number,
        length=8 * NUMBER_BYTES,
        is_signed=True,
        conversion=BaseConversion.factory(is_float=True),
        minimum=low,
        maximum=high,
        unit=unit,
    )


def _signal_in(database: Database, path: str) -> Signal | None:
    """Signal with this name in a database, or None."""
    message, name = path.split(".")
    namesakes: list[AnyMessage] = [m for m in database.messages if m.name == message]
    return next((signal for m in namesakes for signal in m.signals if signal.name == name), None)
