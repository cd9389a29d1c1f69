"""Values of a signal in payloads: conversion of bits to SI, for whole batches.

A value that its sender marks as not available, as an error, or that lies outside its declared range becomes NaN.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal, last_byte
from estimator.can_io.frames import Frames
from estimator.can_io.j1939 import classify, highest_valid
from estimator.signals import Floats, Mask

Raw = NDArray[np.unsignedinteger[Any]]
WORDS = (1, 2, 4, 8)  # bytes
EXACT_BITS = 53  # of a raw value that a floating-point number holds exactly


def extract(data: NDArray[np.uint8], signal: Signal) -> Raw:
    """Raw bits (n,) of a signal of at most 64 bits in payloads (n, whole words), in the byte order of the DBC."""
    little = signal.byte_order == "little_endian"
    # The DBC's start bit of a big-endian signal is its most significant one, counted in its byte from the lowest.
    first = signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8
    last = first + signal.length - 1
    size = next((size for size in WORDS if first // (8 * size) == last // (8 * size)), None)
    if size is None:
        return _extract_across_words(data, signal)
    column, bit = divmod(first, 8 * size)
    word: Raw = np.ascontiguousarray(data).view(f"{'<' if little else '>'}u{size}")[:, column]
    shift = bit if little else 8 * size - bit - signal.length
    if shift:
        word = word >> word.dtype.type(shift)
    return word if shift + signal.length == 8 * size else word & word.dtype.type((1 << signal.length) - 1)


def _extract_across_words(data: NDArray[np.uint8], signal: Signal) -> Raw:
    """Raw bits (n,) as by `extract`, assembled byte by byte, for a signal that crosses words."""
    if signal.byte_order == "little_endian":
        first, shift = divmod(signal.start, 8)
        count = (shift + signal.length + 7) // 8
        columns = range(first, first + count)
    else:
        first, bit = divmod(signal.start, 8)
        count = (7 - bit + signal.length + 7) // 8
        shift = 8 * count - (7 - bit) - signal.length
        columns = range(first + count - 1, first - 1, -1)
    raw = np.zeros(len(data), dtype=np.uint64)
    for number, column in enumerate(columns):
        byte = data[:, column].astype(np.uint64)
        move = 8 * number - shift
        raw |= byte << np.uint64(move) if move >= 0 else byte >> np.uint64(-move)
    return raw & np.uint64((1 << signal.length) - 1)


def needed_bytes(message: BoundMessage) -> int:
    """Smallest number of payload bytes for which a frame of the message is accepted.

    These hold the signals that every frame carries. A multiplexed signal needs its bytes only where it is selected.
    """
    return max(last_byte(bound.multiplexers[-1] if bound.multiplexers else bound.signal) for bound in message.signals)


def _number(raw: Raw, signal: Signal) -> Floats:
    """Scaled values (n,) in the unit of the DBC."""
    if signal.is_float:
        kinds = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}
        integer, real = kinds[signal.length]
        value = raw.astype(integer).view(real).astype(np.float64)
    elif signal.is_signed:
        top = np.uint64(64 - signal.length)
        value = ((raw.astype(np.uint64) << top).view(np.int64) >> np.int64(top)).astype(np.float64)
    else:
        value = raw.astype(np.float64)
    return _scaled(value, float(signal.scale), float(signal.offset))


def _scaled(value: Floats, scale: float, offset: float) -> Floats:
    """Scale and shift an array in place, and return it."""
    if scale != 1:
        value *= scale
    if offset != 0:
        value += offset
    return value


def present(bound: BoundSignal, frames: Frames) -> Mask:
    """Mask (n,) of the frames in which the multiplexers of a signal select it."""
    here = np.ones(len(frames), dtype=bool)
    for signal, multiplexer in pairwise((bound.signal, *bound.multiplexers)):
        selecting = np.array(signal.multiplexer_ids or [], dtype=np.uint64)
        here &= np.isin(extract(frames.data, multiplexer), selecting) & (frames.length >= last_byte(multiplexer))
    return here


def values(message: BoundMessage, bound: BoundSignal, frames: Frames) -> tuple[Floats, dict[str, Mask]]:
    """Values (n,) [SI], NaN where the sender gave none, and masks (n,) of these by reason."""
    signal, conversion = bound.signal, bound.conversion
    raw = extract(frames.data, signal)
    with np.errstate(over="ignore", invalid="ignore"):  # floating-point signals may hold anything
        value = _number(raw, signal)
        cut = frames.length < last_byte(signal)
        if not cut.any() and _are_all_usual(message, bound, value):
            return _scaled(value, conversion.scale, conversion.offset), {}
        si = _scaled(value.copy(), conversion.scale, conversion.offset)
        if bound.tangent:
            np.tan(si, out=si)
    is_number = np.abs(si) <= np.finfo(np.float32).max  # a larger one is damage, and sums of it overflow
    masks = _no_values(message, signal, raw, value, is_number)
    if bound.states is not None:
        si = np.isin(value, bound.states.on).astype(np.float64)
        masks["no state"] = np.isin(value, bound.states.unknown) & ~np.any(list(masks.values()), axis=0)
    if cut.any():
        masks = {"short frame": cut} | {reason: mask & ~cut for reason, mask in masks.items()}
    for mask in masks.values():
        si[mask] = np.nan
    return si, masks


def _are_all_usual(message: BoundMessage, bound: BoundSignal, value: Floats) -> bool:
    """True if the extremes of the scaled values (n,) show that all values of a linear signal are valid."""
    signal, conversion = bound.signal, bound.conversion
    if signal.is_float or bound.tangent or bound.states is not None or signal.length > EXACT_BITS or not len(value):
        return False
    low, high = _range(signal)
    if message.j1939 and not signal.is_signed:
        edge = highest_valid(signal.length) * float(signal.scale) + float(signal.offset)
        low, high = (low, min(high, edge)) if signal.scale > 0 else (max(low, edge), high)
    least, most = float(value.min()), float(value.max())
    extremes = least * conversion.scale + conversion.offset, most * conversion.scale + conversion.offset
    return low <= least and most <= high and all(map(math.isfinite, extremes))


def _range(signal: Signal) -> tuple[float, float]:
    """Range of scaled values that the DBC allows."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not low < high:
        return -math.inf, math.inf
    room = abs(float(signal.scale)) / 2  # half a bit: ranges in DBC files are often written rounded
    return float(low) - room, float(high) + room


def _no_values(message: BoundMessage, signal: Signal, raw: Raw, value: Floats, finite: Mask) -> dict[str, Mask]:
    """Masks (n,) of readings without a value, by the first reason that applies."""
    masks: dict[str, Mask] = {}
    left = np.ones(len(raw), dtype=bool)
    if message.j1939 and not signal.is_signed:
        masks["not available"], masks["error"], masks["reserved value"] = classify(raw, signal.length)
        left = ~np.any(list(masks.values()), axis=0)
    masks["not a number"] = left & ~finite
    low, high = _range(signal)
    masks["out of range"] = left & finite & ((value < low) | (value > high))
    return masks
