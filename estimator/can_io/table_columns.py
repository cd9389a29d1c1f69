"""Columns of a table of measurements: their roles, their units, and the messages that represent them.

A table is processed as frames: each value of a row is a frame of one number, as in a lake of decoded signals. Times
and values are so judged as those of a bus.
"""

import re
from collections.abc import Container, Mapping
from dataclasses import dataclass

from cantools.database.can import Database, Message, Signal
from cantools.database.conversion import BaseConversion

from estimator.can_io.frames import EXTENDED
from estimator.errors import ConfigError, LogError
from estimator.near_names import did_you_mean
from estimator.roles import DIMENSION, GRADES, STATE, Role
from estimator.settings import Table
from estimator.units import Conversion, conversion_of, normal_form, spellings_of

NUMBER_BYTES = 8
FIRST_IDENT = 0x18FF0000  # of groups without a meaning of their own (J1939 proprietary B)
TIME = "time"  # name of the column of times, beside the roles
POWER, FORCE = "power", "force"  # names for the power at the wheels, and for the force there
TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_SECONDS = {normal_form(unit): seconds for unit, seconds in TIME_UNITS.items()}
FORCE_UNITS = {"n": 1.0, "kn": 1e3, "lbf": 4.4482216152605}
WITH_UNIT = re.compile(r"\s*(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?\s*", re.DOTALL)
IN_ROUND = re.compile(r"\s*(?P<name>.*?)\s*\((?P<unit>[^()]*)\)\s*", re.DOTALL)


@dataclass(frozen=True)
class Column:
    """Column in a ``unit``, read for a ``role``, by a ``text``; ``is_force``: its product with the speed is a power."""

    role: Role
    text: str
    unit: str
    is_force: bool = False

    @property
    def signal(self) -> str:
        """Name of its signal: letters, digits and underscores."""
        return re.sub(r"\W+", "_", split_unit(self.text)[0]).strip("_") or "column"

    @property
    def path(self) -> str:
        """Path ``MESSAGE.signal`` in the binding."""
        return f"{self.role.value}.{self.signal}"


def split_unit(text: str) -> tuple[str, str | None]:
    """Split ``speed [km/h]`` into the name of a column and its unit; None without brackets.

    Round brackets do as well, where a unit that is known is in them.
    """
    match = WITH_UNIT.fullmatch(text)
    assert match is not None  # it takes any text
    if match["unit"] is None and (found := IN_ROUND.fullmatch(text)) and _dimension(found["unit"]):
        return found["name"], found["unit"]
    return match["name"], match["unit"]


def name_in(there: Container[str], text: str) -> str:
    """Name of the column that ``speed [km/h]`` means among others: this, unit included, or else ``speed``."""
    whole = text.strip()
    return whole if whole in there else split_unit(text)[0]


def seconds_in(unit: str) -> float | None:
    """Seconds [s] in a unit of time; None if it is not known."""
    return _SECONDS.get(normal_form(unit))


def check_units(source: str, table: Table, there: Container[str], given: Mapping[str, str]) -> None:
    """Check the units of columns against those that are ``given`` in the file, or stand in the names that are there.

    Raises
    ------
    LogError
        A column is asked for in another unit.
    """
    texts = [column.text for column in columns_of(table) if DIMENSION[column.role] != STATE]
    for text in [*texts, *([] if table.time is None else [table.time])]:
        name, unit = name_in(there, text), split_unit(text)[1]
        in_name = split_unit(name)[1]
        own = given.get(name) or in_name
        is_sure = name in given or not name.endswith(")")  # the 1 of "Speed (1)" is none
        if name in there and own and unit and _differ(own, unit, is_sure):
            asked = name if own == in_name else f"{name} [{own}]"
            raise LogError(
                f"{source}: column {name!r} is in {own!r} by the file, and {text!r} takes it in {unit!r}; write "
                f'"{asked}", or correct the unit in the file'
            )


def _differ(own: str, unit: str, is_sure: bool) -> bool:
    """Whether a column's ``own`` unit is known and another than ``unit``; if not ``is_sure``, of its dimension too."""
    return _meaning(own) not in (None, _meaning(unit)) and (is_sure or _dimension(own) == _dimension(unit))


def _meaning(unit: str) -> Conversion | float | None:
    """Conversion or factor of a unit, of a signal, a force or a time; None if it is not known."""
    return FORCE_UNITS.get(normal_form(unit)) or seconds_in(unit) or conversion_of(unit)


def _dimension(unit: str) -> str | None:
    """Dimension of a unit, as `_meaning`; None if it is not known."""
    if normal_form(unit) in FORCE_UNITS:
        return "N"
    conversion = conversion_of(unit)
    return "s" if seconds_in(unit) else None if conversion is None else conversion.dimension


def columns_of(table: Table) -> list[Column]:
    """Columns of a table, in the order of the configuration.

    Raises
    ------
    ConfigError
        A role is not known, or units are missing or do not fit; one message names all of them. Or alternatives do not
        fit the column that they stand for.
    """
    columns, wrong = list[Column](), list[str]()
    names = {role.value for role in Role} - {Role.WHEEL_SPEEDS.value} | {POWER, FORCE}
    for key, text in table.columns.items():
        if key not in names:
            guess = did_you_mean(key, sorted(names)) or f"; the roles are {', '.join(sorted(names))}"
            raise ConfigError(f"table.columns.{key}: no such role{guess}")
        name, unit = split_unit(text)
        role = Role.ENGINE_POWER if key in (POWER, FORCE) else Role(key)
        if not name:
            raise ConfigError(f'table.columns.{key}: names no column; write {key} = "COLUMN [unit]"')
        if reason := _misfit(key, role, unit):
            wrong.append(f'{key} = "{text}" {reason}')
        columns.append(Column(role, text, "" if unit is None else unit, key == FORCE))
    if wrong:
        raise ConfigError(f"table.columns: {'; '.join(wrong)}")
    roles = [column.role for column in columns]
    for role in {role for role in roles if roles.count(role) > 1}:
        raise ConfigError(f"table.columns: {role.value} is given twice; leave one of its columns")
    if any(column.is_force for column in columns) and Role.SPEED not in roles:
        raise ConfigError("table.columns.force: takes the speed to make a power; add a column of speed")
    for key in table.alternatives:
        _check_alternatives(table, key)
    return columns


def texts_of(table: Table, key: str) -> list[str]:
    """Column of a role, or of the time, and its alternatives; empty if there is none."""
    first = table.time if key == TIME else table.columns.get(key)
    return [] if first is None else [first, *table.alternatives.get(key, [])]


def _check_alternatives(table: Table, key: str) -> None:
    """Refuse alternatives of a column that is not given, has their name, or has another kind of unit."""
    texts = texts_of(table, key)
    if not texts:
        raise ConfigError(f"table.alternatives.{key}: goes with a column in table.columns; write that too")
    names = [split_unit(text)[0] for text in texts]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ConfigError(f"table.alternatives.{key}: the column {twice!r} is given twice; leave out one")
    if key == TIME:
        return
    for text in texts[1:]:
        columns_of(Table(columns={**table.columns, key: text}))
        one, other = (split_unit(of)[1] for of in (texts[0], text))
        if one and other and _dimension(one) != _dimension(other):
            raise ConfigError(f'table.alternatives.{key}: "{texts[0]}" and "{text}" are of two kinds; give one of them')


def in_file(source: str, table: Table, there: Container[str]) -> Table:
    """The table with those columns that a file has, of the ones that are given for a role.

    Raises
    ------
    LogError
        It has several columns for a role.
    """
    chosen = dict[str, str]()
    for key in table.alternatives:
        texts = texts_of(table, key)
        found = [text for text in texts if name_in(there, text) in there]
        if len(found) > 1:
            names = " and ".join(repr(name_in(there, text)) for text in found)
            raise LogError(f"{source}: has the columns {names}, each given for {key}; leave out one of them")
        chosen[key] = found[0] if found else texts[0]
    time = chosen.pop(TIME, table.time)
    return Table(time=time, columns={**table.columns, **chosen})


def factor_and_offset(given: Column, first: Column) -> tuple[float, float]:
    """Factor and offset from the unit of a ``given`` column to that of the ``first`` one of its role."""
    if given.is_force:
        return FORCE_UNITS[given.unit.lower()] / FORCE_UNITS[first.unit.lower()], 0.0
    own, other = conversion_of(given.unit), conversion_of(first.unit)
    if own is None or other is None or DIMENSION[given.role] == STATE:
        return 1.0, 0.0
    return own.scale / other.scale, (own.offset - other.offset) / other.scale


def _misfit(key: str, role: Role, unit: str | None) -> str:
    """Reason why a unit does not fit the role of a column; empty if it fits."""
    if key == FORCE:
        return "" if (unit or "").lower() in FORCE_UNITS else f"needs one of the units {' '.join(FORCE_UNITS)}"
    dimension = DIMENSION[role]
    if dimension == STATE:
        return ""
    conversion = conversion_of(unit)
    if unit is None:
        return f'has no unit; write it in brackets, as in {key} = "COLUMN [{spellings_of(dimension)[0]}]"'
    if conversion is None or (
        conversion.dimension != dimension and not (role in GRADES and conversion.dimension == "rad")
    ):
        return f"needs one of the units {' '.join(spellings_of(dimension))}"
    return ""


def binding_of(table: Table) -> Mapping[str, str]:
    """Binding of each role to ``MESSAGE.signal``, as for a bus."""
    return {column.role.value: column.path for column in columns_of(table)}


def database_of(table: Table) -> Database:
    """Database of one message for each column, a 64-bit number in the unit of the column."""
    return Database([_message(i, column) for i, column in enumerate(columns_of(table))])


def ident_of(index: int) -> int:
    """Identifier of the frames of a column, by its index."""
    return EXTENDED | FIRST_IDENT | index << 8


def _message(index: int, column: Column) -> Message:
    signal = Signal(
        name=column.signal,
        start=0,
        length=8 * NUMBER_BYTES,
        is_signed=True,
        conversion=BaseConversion.factory(is_float=True),
        unit="W" if column.is_force else column.unit,
    )
    return Message(
        frame_id=FIRST_IDENT | index << 8,
        name=column.role.value,
        length=NUMBER_BYTES,
        signals=[signal],
        is_extended_frame=True,
        protocol="j1939",  # so that the last byte of an id is its sender
    )
