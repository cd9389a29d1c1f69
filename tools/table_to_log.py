r"""Convert a table of measurements to a CAN log by a DBC: every row gives one frame of each mapped message.

python tools/table_to_log.py TABLE.csv LOG.blf --dbc my.dbc --time "t [s]" \
    --map "MOTION.Speed=speed" --map "ENGINE.Power=fuel (g/s)*17.976-2.5" [--select vehicle=7 --select phase=2]

A mapping reads MESSAGE.signal=column[*factor][+offset]; the result is in the unit that the DBC gives the signal. Times
are in seconds, from a column (which may be scaled the same way) or, with --rate, from the number of a row.
A value that is empty, NaN or outside the range of its signal is sent as "not available" by J1939 messages; other
messages have no such value, so their frame is left out. Both are counted. Parquet tables need pyarrow.

Example, a truck of a public study whose table holds mass flow of fuel: 42.8 kJ/g (lower heating value of diesel) times
an efficiency of 0.42 give kW at the crank, and `roadload estimate --config tools/vt_truck.toml truck.blf` reads it:

python tools/table_to_log.py veh002_all.csv truck.blf --dbc tools/vt_truck.dbc --rate 1 \
    --map "MOTION.Speed=vel (mph)" --map "ENGINE.Power=fuel (g/s)*17.976" \
    --map "ENGINE.Speed=engine (rpm)" --map "ROAD.Elevation=elevation (m)"
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from cantools.database.can import Database, Message, Signal
from table import Table, read_table

from estimator.can_io.binding import load_database
from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.can_io.j1939_encoder import EPOCH, HIGHEST_VALID
from estimator.can_io.log_writer import WRITABLE, write_log
from estimator.errors import ConfigError, DatabaseError, InputError, LogError, RoadloadError
from estimator.output_files import check_suffix
from estimator.signals import Floats, Mask

SINCE_1970 = 1e9  # s, larger times are dates


def times_of(table: Table, time: str | None, rate: float | None) -> Floats:
    """Times (n,) [s] by a column, or by the places of the rows at ``rate`` [1/s]."""
    if time is not None:
        return table.scaled(time)
    assert rate is not None  # the parser takes one of the two
    return np.arange(len(table)) / rate


def _check_ascending(table: Table, t: Floats) -> None:
    """Check that every row has a time and that times increase."""
    bad = ~np.isfinite(t)
    bad[1:] |= np.diff(t) <= 0
    if bad.any():
        i = int(np.argmax(bad))
        fix = "sort the table, or --select one vehicle or phase"
        before = f" after {t[i - 1]:g}" if i else ""
        raise InputError(f"{table.path}: row {table.line[i]}: time {t[i]:g}{before} does not go forward; {fix}")


def frames_of_table(table: Table, t: Floats, database: Database, mappings: list[str]) -> tuple[Frames, list[str]]:
    """Frames of a table's rows at times ``t`` (n,) [s], and remarks on values that could not be sent.

    Raises
    ------
    ConfigError, DatabaseError
        A mapping is malformed, names an unknown signal or column, or a message that does not fit into one frame.
    InputError
        A cell is not a number, or time does not increase; the message names row and column.
    """
    _check_ascending(table, t)
    values: dict[str, dict[str, Floats]] = {}
    for mapping in mappings:
        path, equals, expression = mapping.partition("=")
        message, dot, signal = path.strip().partition(".")
        if not (equals and dot and expression.strip()):
            raise ConfigError(f"--map {mapping!r}: is not of the form MESSAGE.signal=column[*factor][+offset]")
        if signal in values.setdefault(message, {}):
            raise ConfigError(f"--map {mapping!r}: {path.strip()} is mapped twice; leave one out")
        values[message][signal] = table.scaled(expression.strip())
    remarks: list[str] = []
    parts = [_frames_of_message(_message(database, name), t, columns, remarks) for name, columns in values.items()]
    frames = Frames.concatenate(parts)
    if not len(frames):
        raise LogError(f"{table.path}: no frame is left; {'; '.join(remarks)}")
    return frames[np.argsort(frames.t, kind="stable")], remarks


def _message(database: Database, name: str) -> Message:
    try:
        message = database.get_message_by_name(name)
    except KeyError:
        has = ", ".join(message.name for message in database.messages)
        raise DatabaseError(f"--map {name}: the DBC has no such message; it has {has}") from None
    if message.protocol == "j1939" and message.length > CLASSIC_BYTES:
        raise DatabaseError(f"--map {name}: {message.length} bytes do not fit into one frame; map another message")
    return message


def _frames_of_message(message: Message, t: Floats, columns: dict[str, Floats], remarks: list[str]) -> Frames:
    j1939 = message.protocol == "j1939"
    signals = {signal.name: signal for signal in message.signals}
    unknown = [name for name in columns if name not in signals]
    if unknown:
        raise DatabaseError(f"--map {message.name}.{unknown[0]}: no such signal; it has {', '.join(signals)}")
    content = {name: np.full(len(t), _unset(signal, j1939)) for name, signal in signals.items()}
    there = np.ones((len(columns), len(t)), dtype=bool)
    for k, (name, value) in enumerate(columns.items()):
        signal = signals[name]
        raw, known = _raw(signal, value, j1939)
        there[k] = known
        content[name] = np.where(known, raw, content[name])
        empty, missing = int(np.isnan(value).sum()), int((~known).sum())
        if missing:
            what = "not available" if j1939 else "frame left out"
            remarks.append(f"{message.name}.{name}: {empty} empty, {missing - empty} out of range: {what}")
    unmapped = [name for name in signals if name not in columns]
    if unmapped and not j1939:
        remarks.append(f"{message.name}: nothing is mapped to {', '.join(unmapped)}, which will read their start value")
    rows = np.flatnonzero(there.any(axis=0) if j1939 else there.all(axis=0))
    payloads = [_encode(message, {name: raw[i].item() for name, raw in content.items()}, j1939) for i in rows.tolist()]
    width = max(CLASSIC_BYTES, message.length)
    data = np.frombuffer(b"".join(p.ljust(width, b"\0") for p in payloads), np.uint8).reshape(-1, width)
    ident = message.frame_id | (EXTENDED if message.is_extended_frame else 0)
    start = 0.0 if t[0] > SINCE_1970 else EPOCH
    return Frames(
        start + t[rows], np.full(len(rows), ident, np.uint32), np.full(len(rows), message.length, np.uint8), data
    )


def _unset(signal: Signal, j1939: bool) -> float | int:
    """Raw value of a signal without a value: all ones in J1939, elsewhere the DBC's initial value."""
    if j1939:
        return np.nan if signal.is_float else -1 if signal.is_signed else (1 << signal.length) - 1
    return signal.raw_initial or 0


def _raw(signal: Signal, value: Floats, j1939: bool) -> tuple[Floats, Mask]:
    """Raw numbers (n,), and whether the value is inside the signal's range (n,)."""
    with np.errstate(invalid="ignore"):
        half_bit = 0.0 if signal.is_float else abs(signal.scale) / 2
        low = -np.inf if signal.minimum is None else signal.minimum - half_bit
        high = np.inf if signal.maximum is None else signal.maximum + half_bit
        known = np.isfinite(value) & (value >= low) & (value <= high)
        raw = (value - signal.offset) / signal.scale
        if signal.is_float:
            return raw, known
        raw = np.round(raw)
        span = 1 << signal.length
        smallest, largest = (-(span // 2), span // 2 - 1) if signal.is_signed else (0, span - 1)
        if j1939:
            largest = min(largest, HIGHEST_VALID.get(signal.length, largest))
        known &= (raw >= smallest) & (raw <= largest)
    return np.where(known, raw, 0).astype(np.int64), known


def _encode(message: Message, raw: dict[str, Any], j1939: bool) -> bytes:
    try:
        return message.encode(raw, scaling=False, padding=j1939, strict=False)
    except (cantools.Error, ValueError, OverflowError) as error:
        raise DatabaseError(f"{message.name}: cannot be encoded: {error}") from error


def convert(
    table: Table,
    log: Path,
    dbc: list[str],
    mappings: list[str],
    time: str | None,
    rate: float | None,
    select: list[str],
) -> tuple[int, float, list[str]]:
    """Write a log of the selected rows; returns the number of frames, the time they span [s], and remarks.

    Raises
    ------
    InputError
        An option or a cell of the table cannot be used.
    """
    check_suffix(log, WRITABLE)
    t = times_of(table, time, rate)
    chosen = np.all([np.ones(len(table), bool), *(table.where(condition) for condition in select)], axis=0)
    if not chosen.any():
        raise ConfigError(f"{table.path}: no row meets all of {', '.join(select)}; leave one out")
    frames, remarks = frames_of_table(table[chosen], t[chosen], load_database(dbc), mappings)
    write_log(frames, log)
    return len(frames), float(frames.t[-1] - frames.t[0]), remarks


def main(arguments: list[str] | None = None) -> int:
    """Convert one table; exit status 0, 2 for bad input, 1 when it could not be written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, metavar="TABLE.csv|.parquet")
    parser.add_argument("log", type=Path, metavar="LOG.blf", help=f"what to write: {' '.join(WRITABLE)}")
    parser.add_argument("--dbc", action="append", default=[], metavar="FILE.dbc", help="default: the shipped J1939")
    parser.add_argument("--map", action="append", required=True, metavar="MESSAGE.signal=column[*factor][+offset]")
    clock = parser.add_mutually_exclusive_group(required=True)
    clock.add_argument("--time", metavar="COLUMN[*factor]", help="column of times [s]")
    clock.add_argument("--rate", type=float, metavar="HZ", help="rows a second, where there is no such column")
    parser.add_argument("--select", action="append", default=[], metavar="column=value", help="only these rows")
    options = parser.parse_args(arguments)
    if options.rate is not None and not 0 < options.rate < np.inf:
        parser.error(f"--rate: {options.rate:g} is not a positive number")
    try:
        table = read_table(options.table)
        count, span, remarks = convert(
            table, options.log, options.dbc, options.map, options.time, options.rate, options.select
        )
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    print(f"{options.log}: {count:,} frames over {span:,.0f} s")
    for remark in remarks:
        print(f"note: {remark}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
