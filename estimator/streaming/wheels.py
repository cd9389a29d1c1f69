"""Vehicle speed as the mean of the wheel speeds that agree.

Wheels differ by some per cent in a curve and by slip, and a locked or spinning one for a moment by more. A wheel is
left out of the mean

* while its value is constant and the others change: a dead sensor, at zero or at its last value, or a locked wheel;
* once it differs from the majority of the wheels by more than slip and a curve explain at that speed, until it differs
  by no more than slip: a wrong scale.

Without a majority the right wheels are unknown, and so is the speed.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask

STILL = 1e-9  # m/s, by which means of equal readings differ
MAX_STILL_CHANGE = 2.0  # m/s that the others change by while a wheel does not: far beyond any resolution
MIN_SPEED = 8.0  # m/s, from which wheels are compared: at 6 m/s^2 sideways the curve is wider than 10 m
MAX_SLIP = 0.05  # of the faster wheel: tyres that are worn, and that pull or brake for seconds
MAX_SIDEWAYS = 12.8  # m^2/s^2, track (2.1 m) times acceleration (6 m/s^2): wheels of a curve differ, times speed
MIN_ROWS = 20  # 2 s without a change, until a comparison counts: wheels spin and lock for a moment

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
        self._compared: dict[int, _Compared] = {}  # by the wheel's place

    def mean(self, speeds: Floats, places: Sequence[int]) -> tuple[Floats, Mask]:
        """Mean [m/s] (n,) of the speeds of k wheels (k, n), NaN where none is known, and rows without a majority (n,).

        ``places`` (k,) are the numbers of the wheels in the configuration, from 0.
        """
        is_used = np.isfinite(speeds)
        undecided = np.zeros(speeds.shape[1], dtype=bool)
        if len(speeds) >= 2:
            if self._still is None or self._still.wheels != len(speeds):
                self._still = _Still(len(speeds))
            still = self._still.feed(speeds)
            out = self._left_out(np.where(still, np.nan, speeds), places)
            undecided[:] = is_used.any(axis=0) & ~(is_used & ~still & ~out).any(axis=0) & out.any(axis=0)
            self._count(still & is_used, out & is_used & ~undecided, undecided, places)
            is_used &= ~still & ~out
        total = np.where(is_used, speeds, 0.0).sum(axis=0)
        count = is_used.sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan), undecided

    def pause(self) -> None:
        """Start anew after a gap; the wheels left out so far stay so until the next comparison that holds."""
        self._still = None
        for compared in self._compared.values():
            compared.rows = 0

    def forget(self) -> None:
        """Discard the comparisons: the vehicle may be another one."""
        self.pause()
        self._compared.clear()

    def _left_out(self, speeds: Floats, places: Sequence[int]) -> Mask:
        """Mask (k, n) of the wheels left out by the last comparison that held for MIN_ROWS rows."""
        with np.errstate(invalid="ignore"):
            decisive = np.flatnonzero((speeds > MIN_SPEED).any(axis=0))
        compared = speeds[:, decisive]
        differs, agrees = _outside_majority(compared, MAX_SIDEWAYS), ~_outside_majority(compared, 0.0)
        verdicts = np.where(np.isfinite(compared), differs.astype(np.int8) - (agrees & ~differs), 0)
        out = np.empty(speeds.shape, dtype=bool)
        for place, wheel_verdicts, row in zip(places, verdicts, out, strict=True):
            row[:] = self._compared.setdefault(place, _Compared()).feed(wheel_verdicts, decisive, len(row))
        return out

    def _count(self, still: Mask, out: Mask, undecided: Mask, places: Sequence[int]) -> None:
        for reason, masks in ((STANDS_STILL, still), (DIFFERS, out & ~still)):
            for i in np.flatnonzero(masks.any(axis=1)).tolist():
                self.refused[f"wheel_speeds {places[i] + 1}: {reason}"] += int(masks[i].sum())
        if undecided.any():
            self.refused[f"wheel_speeds: {UNDECIDED}"] += int(undecided.sum())


def _outside_majority(speeds: Floats, sideways: float) -> Mask:
    """Mask (k, n) of the known wheels outside the majority, and of all known wheels where there is no majority.

    Two wheels agree if MAX_SLIP and a curve with the product ``sideways`` [m^2/s^2] explain their difference.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        faster = np.abs(np.maximum(speeds[:, None], speeds[None]))
        agree = np.abs(speeds[:, None] - speeds[None]) <= MAX_SLIP * faster + sideways / faster  # False if not known
    votes = agree.sum(axis=1)
    largest = votes == votes.max(axis=0)
    split = (largest[:, None] & largest[None] & ~agree).any(axis=(0, 1)) & np.isfinite(speeds).any(axis=0)
    apart: Mask = np.isfinite(speeds) & (~largest | split)
    return apart


@dataclass(slots=True)
class _Compared:
    """Whether a wheel is left out, and the newest verdict on it: 1 it differs, -1 it agrees, 0 neither."""

    is_out: bool = False
    verdict: int = 0
    rows: int = 0  # that the verdict has held for

    def feed(self, verdicts: NDArray[np.int8], decisive: NDArray[np.intp], n: int) -> Mask:
        """Mask (n,) of the rows without the wheel, from the ``verdicts`` on rows that are ``decisive``, both (d,)."""
        series = np.concatenate([[self.verdict], verdicts])
        index = np.arange(len(series))
        begun = np.maximum.accumulate(np.where(np.diff(series, prepend=series[0]) != 0, index, 1 - self.rows))
        rows = index - begun + 1
        events = np.zeros(n + 1, dtype=np.int8)
        events[0] = 1 if self.is_out else -1
        events[1 + decisive] = np.where(rows[1:] >= MIN_ROWS, verdicts, 0)
        newest = np.maximum.accumulate(np.where(events != 0, np.arange(n + 1), 0))
        out: Mask = events[newest] > 0
        self.is_out, self.verdict = bool(out[-1]), int(series[-1])
        self.rows = int(rows[-1]) if len(verdicts) else self.rows
        return out[1:]


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
