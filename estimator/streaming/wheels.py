"""Vehicle speed as the mean of the wheel speeds that agree.

Wheels differ by some per cent in a curve and by slip, and a locked or spinning one for a moment by more. A wheel is
left out of the mean

* while its value is constant and the others change: a dead sensor, at zero or at its last value, or a locked wheel;
* where it differs from the majority of the wheels by more than a curve explains at that speed: a wrong scale.

Without a majority the right wheels are unknown, and so is the speed.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask

STILL = 1e-9  # m/s, by which means of equal readings differ
MAX_STILL_CHANGE = 2.0  # m/s that the others change by while a wheel does not: far beyond any resolution
MIN_SPEED = 8.0  # m/s, from which wheels are compared: at 6 m/s^2 sideways the curve is wider than 10 m
MAX_DIFFERENCE = 0.25  # of the faster wheel: in that curve, inner and outer wheel differ by 0.2 and the axles by less
MIN_ROWS = 20  # 2 s without a change, until a comparison counts: wheels spin and lock for a moment
MAX_WHEELS = 16  # that one code has bits for; trailers send more than one message

STANDS_STILL, DIFFERS = "stands still while the others change", "differs from the others"
UNDECIDED = "half of them contradict the others"


class Wheels:
    """Computes the mean of wheel speeds row by row; the result does not depend on how rows are cut into batches.

    Attributes
    ----------
    refused : collections.Counter[str]
        Rows in which a wheel was left out, by wheel and reason.
    """

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self._still: _Still | None = None
        self._code, self._run, self._counts = 0, 0, 0  # of the newest comparison, rows with it, and that which counts

    def mean(self, speeds: Floats, places: Sequence[int]) -> tuple[Floats, Mask]:
        """Mean [m/s] (n,) of the speeds of k wheels (k, n), NaN where none is known, and rows without a majority (n,).

        ``places`` (k,) are the numbers of the wheels in the configuration, from 0.
        """
        is_used = np.isfinite(speeds)
        undecided = np.zeros(speeds.shape[1], dtype=bool)
        if 2 <= len(speeds) <= MAX_WHEELS:
            if self._still is None or self._still.wheels != len(speeds):
                self._still = _Still(len(speeds))
            still = self._still.feed(speeds)
            out = self._left_out(np.where(still, np.nan, speeds))
            undecided[:] = is_used.any(axis=0) & ~(is_used & ~still & ~out).any(axis=0) & out.any(axis=0)
            self._count(still & is_used, out & is_used & ~undecided, undecided, places)
            is_used &= ~still & ~out
        total = np.where(is_used, speeds, 0.0).sum(axis=0)
        count = is_used.sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan), undecided

    def pause(self) -> None:
        """Start anew after a gap; the wheels left out so far stay so until the next comparison that holds."""
        self._still, self._run = None, 0

    def forget(self) -> None:
        """Discard the comparisons: the vehicle may be another one."""
        self.pause()
        self._code, self._counts = 0, 0

    def _left_out(self, speeds: Floats) -> Mask:
        """Mask (k, n) of the wheels left out by the last comparison that held for MIN_ROWS rows."""
        bits = 1 << np.arange(len(speeds))
        code = bits @ _outside_majority(speeds)
        with np.errstate(invalid="ignore"):
            decisive = np.flatnonzero((speeds > MIN_SPEED).any(axis=0))
        codes = np.concatenate([[self._code], code[decisive]])
        index = np.arange(len(codes))
        changed = np.maximum.accumulate(np.where(np.diff(codes, prepend=codes[0]) != 0, index, 1 - self._run))
        run = index - changed + 1
        run[0] = self._run
        counts = np.full(speeds.shape[1], -1)
        counts[decisive] = np.where(run[1:] >= MIN_ROWS, codes[1:], -1)
        self._code, self._run = int(codes[-1]), int(run[-1])
        newest = np.maximum.accumulate(np.where(counts >= 0, np.arange(len(counts)), -1))
        held = np.where(newest >= 0, counts[newest], self._counts)
        self._counts = int(held[-1]) if len(held) else self._counts
        out: Mask = (held & bits[:, None]) != 0
        return out

    def _count(self, still: Mask, out: Mask, undecided: Mask, places: Sequence[int]) -> None:
        for reason, masks in ((STANDS_STILL, still), (DIFFERS, out & ~still)):
            for i in np.flatnonzero(masks.any(axis=1)).tolist():
                self.refused[f"wheel_speeds {places[i] + 1}: {reason}"] += int(masks[i].sum())
        if undecided.any():
            self.refused[f"wheel_speeds: {UNDECIDED}"] += int(undecided.sum())


def _outside_majority(speeds: Floats) -> NDArray[np.int64]:
    """1 for each known wheel (k, n) outside the majority, and for all known wheels where there is no majority."""
    with np.errstate(invalid="ignore"):
        faster = np.maximum(speeds[:, None], speeds[None])
        agree = np.abs(speeds[:, None] - speeds[None]) <= MAX_DIFFERENCE * np.abs(faster)  # False where not known
    votes = agree.sum(axis=1)
    largest = votes == votes.max(axis=0)
    split = (largest[:, None] & largest[None] & ~agree).any(axis=(0, 1)) & np.isfinite(speeds).any(axis=0)
    apart: NDArray[np.int64] = (np.isfinite(speeds) & (~largest | split)).astype(np.int64)
    return apart


class _Still:
    """Detects wheels whose value is constant while the mean of the others changes by MAX_STILL_CHANGE."""

    def __init__(self, wheels: int) -> None:
        self.wheels = wheels
        self._last = np.full(wheels, np.nan)  # [m/s] of the row before
        self._others = np.full(wheels, np.nan)  # [m/s] mean of the others when each last changed
        self._is_still = np.zeros(wheels, dtype=bool)

    def feed(self, speeds: Floats) -> Mask:
        """Mask (k, n) of the wheels that stand still."""
        is_known = np.isfinite(speeds)
        count = is_known.sum(axis=0)
        total = np.where(is_known, speeds, 0.0).sum(axis=0)
        still = np.zeros(speeds.shape, dtype=bool)
        index = np.arange(speeds.shape[1])
        for i, speed in enumerate(speeds):
            others = np.where(
                count > is_known[i],
                (total - np.where(is_known[i], speed, 0.0)) / np.maximum(count - is_known[i], 1),
                np.nan,
            )
            with np.errstate(invalid="ignore"):
                is_same = np.abs(np.diff(speed, prepend=self._last[i])) <= STILL
                begun = np.maximum.accumulate(np.where(is_same, -1, index))
                then = np.where(begun >= 0, others[begun], self._others[i])
                far = np.abs(others - then) > MAX_STILL_CHANGE
            last_far = np.maximum.accumulate(np.where(far, index, -1))
            still[i] = np.where(begun >= 0, last_far > begun, (last_far >= 0) | self._is_still[i])
            self._last[i], self._others[i], self._is_still[i] = speed[-1], then[-1], still[i, -1]
        return still
