"""Forged traffic: frames of a recording with another sender, value, rate or time. Layouts are those of j1939.dbc."""

from dataclasses import replace
from functools import cache

import numpy as np
from cantools.database.can import Database, Signal
from numpy.typing import NDArray

from estimator.can_io.binding import load_database
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import pgn_of
from estimator.can_io.j1939_encoder import BAM, EPOCH, TP_CM, frames_of
from estimator.can_io.signal_values import extract
from estimator.signals import Floats, Role, Series

JUST_AFTER = 0.0005  # s, between a frame and its forgery


@cache
def database() -> Database:
    """The shipped J1939 layouts."""
    return load_database([])


def group(frames: Frames, message: str) -> Frames:
    """The single frames of one message."""
    return frames[(pgn_of(frames.ident) == _number_of(message)) & (frames.ident & EXTENDED != 0)]


def announcements(frames: Frames, message: str) -> Frames:
    """The frames that announce a broadcast of one message in several packets (BAM, SAE J1939-21)."""
    number = np.array([*_number_of(message).to_bytes(3, "little")], np.uint8)
    is_announcement = (frames.ident & ~np.uint32(0xFF) == TP_CM | EXTENDED) & (frames.data[:, 0] == BAM)
    return frames[is_announcement & (frames.data[:, 5:] == number).all(axis=1)]


def between(frames: Frames, start: float, stop: float) -> Frames:
    """The frames from ``start`` to ``stop`` [s]."""
    return frames[(frames.t >= start) & (frames.t < stop)]


def from_address(frames: Frames, source: int) -> Frames:
    """The same frames, sent by another address."""
    return replace(frames, ident=frames.ident & np.uint32(0xFFFFFF00) | np.uint32(source))


def later(frames: Frames, by: float | NDArray[np.float64]) -> Frames:
    """The same frames, each ``by`` [s] later: one number, or one for each (n,)."""
    return replace(frames, t=frames.t + by)


def repeated(frames: Frames, times: int) -> Frames:
    """Every frame so many times, evenly up to the next one."""
    gaps = np.append(np.diff(frames.t), 0.0)
    return merged(*(later(frames, gaps * (k + 0.5) / times) for k in range(times)))


def merged(*parts: Frames) -> Frames:
    """All frames in the order of time."""
    frames = Frames.concatenate(list(parts))
    return frames[np.argsort(frames.t, kind="stable")]


def scaled(frames: Frames, message: str, signal: str, factor: float | NDArray[np.float64]) -> Frames:
    """Single frames of ``message`` with one signal multiplied, in its own unit; special values stay."""
    layout = database().get_message_by_name(message).get_signal_by_name(signal)
    raw = extract(frames.data, layout).astype(np.float64)
    scale, offset = float(layout.scale), float(layout.offset)
    highest = 0xFA << (layout.length - 8) if layout.length >= 8 else (1 << layout.length) - 3
    forged = np.clip(np.round(((raw * scale + offset) * factor - offset) / scale), 0, highest)
    return replace(frames, data=_placed(frames.data, layout, np.where(raw > highest, raw, forged)))


def given(frames: Frames, message: str, signal: str, raw: NDArray[np.int64]) -> Frames:
    """Single frames of ``message`` with the raw values (n,) in the place of one signal."""
    layout = database().get_message_by_name(message).get_signal_by_name(signal)
    return replace(frames, data=_placed(frames.data, layout, raw.astype(np.float64)))


def reference_torque(t: Floats, torque: float, source: int) -> Frames:
    """Broadcasts of EC1 that begin at times ``t`` (n,) [s] and give ``torque`` [N m]."""
    frames = frames_of({Role.REFERENCE_TORQUE: Series(t - EPOCH, np.full(len(t), torque))})
    return from_address(frames, source)


def _number_of(message: str) -> int:
    return int(pgn_of(np.array([database().get_message_by_name(message).frame_id], np.uint32))[0])


def _placed(data: NDArray[np.uint8], signal: Signal, raw: NDArray[np.float64]) -> NDArray[np.uint8]:
    if signal.byte_order != "little_endian":
        raise ValueError(f"{signal.name}: not little-endian")
    first, shift = divmod(signal.start, 8)
    mask = ((1 << signal.length) - 1) << shift
    word = raw.astype(np.uint64) << np.uint64(shift)
    placed = data.copy()
    for k in range((shift + signal.length + 7) // 8):
        kept = 0xFF ^ (mask >> 8 * k & 0xFF)
        placed[:, first + k] = placed[:, first + k] & kept | (word >> np.uint64(8 * k) & np.uint64(0xFF)).astype(
            np.uint8
        )
    return placed
