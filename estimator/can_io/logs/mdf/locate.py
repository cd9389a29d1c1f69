"""Location of records of several kinds in a stream, each after an id that determines its size.

The place of each record follows from the previous one. Many stretches are followed in parallel. The first record of a
stretch is guessed from a chain of records that begins shortly before it. If the stretch before it ends elsewhere, it is
followed again from the right place.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.logs.mdf.groups import MAX_ID_VALUE, Group

Places = NDArray[np.int64]
Ids = NDArray[np.unsignedinteger[Any]]

SIZE_BYTES = 4  # of the size that a record of variable size begins with
ROOM = 96  # bytes behind the data that may be looked at: an id, a size and a payload
STRETCH = 1024  # bytes that are followed record by record
MIN_STRETCHES = 16  # fewer are followed one after the other
LEAD = 192  # bytes before a stretch from which on chains are tried
TRIES = 96  # places at which they are
MAX_ROUNDS = 8  # in which wrong beginnings are corrected


class Located(NamedTuple):
    """Places (n,) of the complete records, their ids (n,), the bytes used, and the error found after them."""

    at: Places
    ids: Ids
    used: int
    fault: str


class Chain:
    """Steps from record to record in ``data``, which ends in ROOM further bytes."""

    def __init__(self, data: bytes, id_bytes: int, groups: tuple[Group, ...]) -> None:
        self.size = len(data) - ROOM
        self.low_bytes = np.frombuffer(data, np.uint8, self.size)
        frames = [group for group in groups if group.frames is not None]
        self.usual = {group.record_id & 0xFF for group in frames or groups}
        self._ids = np.ndarray((self.size + 1,), f"<u{id_bytes}", data, 0, (1,))
        self._sizes = np.ndarray((self.size + 1,), "<u4", data, id_bytes, (1,))
        self._steps = np.zeros(MAX_ID_VALUE + 2 if id_bytes > 1 else 256, np.int64)  # 0: no record
        self._is_variable = np.zeros(len(self._steps), np.int64)
        for group in groups:
            self._steps[group.record_id] = id_bytes + (SIZE_BYTES if group.has_variable_size else group.record_bytes)
            self._is_variable[group.record_id] = group.has_variable_size

    def ids(self, at: Places) -> Ids:
        """Ids (n,) of records at places (n,); an invalid id counts as the largest."""
        ids = self._ids[at]
        return ids if ids.dtype == np.uint8 else np.minimum(ids, ids.dtype.type(len(self._steps) - 1))

    def steps(self, at: Places) -> Places:
        """Sizes (n,) [bytes] of records at places (n,); 0 if there is none."""
        ids = self.ids(at)
        steps: Places = self._steps[ids] + self._is_variable[ids] * self._sizes[at]
        return steps

    def walk(self, first: int) -> Places:
        """Places (n,) of the records from ``first`` on, one by one; the last may be invalid or incomplete."""
        places: list[int] = []
        steps, is_variable = self._steps.tolist(), self._is_variable.tolist()
        at, last = first, len(steps) - 1
        while at < self.size:
            places.append(at)
            number = min(int(self._ids[at]), last)
            if steps[number] == 0:
                break
            at += steps[number] + (int(self._sizes[at]) if is_variable[number] else 0)
        return np.array(places, np.int64)


class Paths(NamedTuple):
    """Places (m, k) of the records of k stretches, padded with -1, and the place (k,) after the last of each."""

    places: Places
    finals: Places


def locate(data: bytes, id_bytes: int, groups: tuple[Group, ...]) -> Located:
    """Find the complete records in ``data``, the first of which begins at 0; its last ROOM bytes are padding."""
    chain = Chain(data, id_bytes, groups)
    count = chain.size // STRETCH
    at = chain.walk(0) if count < MIN_STRETCHES else _side_by_side(chain, np.arange(count, dtype=np.int64) * STRETCH)
    if not len(at):
        return Located(at, chain.ids(at), 0, "")
    last, fault = int(at[-1]), ""
    step = int(chain.steps(at[-1:])[0])
    if step == 0:
        fault = "a record with an unknown id"
    complete = step > 0 and last + step <= chain.size
    return Located(at if complete else at[:-1], chain.ids(at if complete else at[:-1]), last + step * complete, fault)


def _side_by_side(chain: Chain, stretches: Places) -> Places:
    """Follow the records of ``stretches`` (k,) in parallel; the first stretch begins with a record."""
    ends = np.append(stretches[1:], chain.size)
    begins = _arrivals(chain, stretches)
    places, finals = _follow(chain, begins, ends)
    sound = len(begins)
    for _ in range(MAX_ROUNDS):
        wrong = np.flatnonzero(begins[1:] != finals[:-1]) + 1
        sound = int(wrong[0]) if len(wrong) else len(begins)
        if not len(wrong):
            break
        begins[wrong] = finals[wrong - 1]
        again = _follow(chain, begins[wrong], ends[wrong])
        finals[wrong] = again.finals
        rows = max(len(places), len(again.places))
        places = np.pad(places, ((0, rows - len(places)), (0, 0)), constant_values=-1)
        places[:, wrong] = -1
        places[: len(again.places), wrong] = again.places
    else:
        wrong = np.flatnonzero(begins[1:] != finals[:-1]) + 1
        sound = int(wrong[0]) if len(wrong) else len(begins)
    at = places[:, :sound].T.ravel()
    at = at[at >= 0]
    return at if sound == len(begins) else np.concatenate((at, chain.walk(int(finals[sound - 1]))))


def _follow(chain: Chain, begins: Places, ends: Places) -> Paths:
    """Follow records from each of the places ``begins`` (k,) to ``ends`` (k,); a broken chain ends after the data."""
    at, rows = begins.copy(), []
    under_way = at < ends
    while under_way.any():
        rows.append(np.where(under_way, at, -1))
        steps = chain.steps(np.minimum(at, chain.size))
        at = np.where(under_way, np.where(steps > 0, at + steps, chain.size), at)
        under_way = at < ends
    return Paths(np.array(rows, np.int64).reshape(-1, len(begins)), at)


def _arrivals(chain: Chain, stretches: Places) -> Places:
    """Places (k,) at which chains of records that begin before a stretch (k,) enter it."""
    arrivals = stretches.copy()
    table = chain.low_bytes[: len(stretches) * STRETCH].reshape(-1, STRETCH)
    windows = table[:-1, STRETCH - LEAD : STRETCH - LEAD + TRIES]
    stretch, tried = np.nonzero(np.logical_or.reduce([windows == number for number in chain.usual]))
    stretch += 1
    at = stretches[stretch] - LEAD + tried
    while len(at):
        steps = chain.steps(at)
        at = at + steps
        arrived = (at >= stretches[stretch]) & (steps > 0)
        arrivals[stretch[arrived][::-1]] = at[arrived][::-1]  # of several, the one that sets off first
        going = (steps > 0) & ~arrived
        at, stretch = at[going], stretch[going]
    return arrivals
