"""Counts of the rows that became usable, and the times without speed or power."""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from estimator.samples import STEP, Rows
from estimator.streaming.alignment import MAX_LINE
from estimator.streaming.remarks import SwitchUse

SILENT = f"speed and power not read within {MAX_LINE:g} s"
MAX_GAPS = 1000  # newest gaps that are kept: bounds the memory of a daemon

Gap = tuple[float, float]  # from and to [s]


class RowCounts:
    """Counts rows, which come run by run; `pause` ends a run, and no gap is noted up to the next one.

    Attributes
    ----------
    valid : int
        Rows with both speed and power.
    unusable : collections.Counter[str]
        Rows without speed or power, by reason, since the start of this process.
    gaps : collections.deque[Gap]
        Times without speed or power.
    switches : SwitchUse
        Rows that switches exclude.
    until : float or None
        End [s] of the rows of the present run; None between two runs.
    """

    def __init__(self, valid: int = 0, gaps: Iterable[Gap] = ()) -> None:
        self.valid = valid
        self.unusable: Counter[str] = Counter()
        self.gaps: deque[Gap] = deque(gaps, maxlen=MAX_GAPS)
        self.switches = SwitchUse()
        self.until: float | None = None

    def pause(self) -> None:
        """End the run of rows, before an interruption."""
        self.until = None

    def silences(self, parts: Sequence[Rows | None]) -> dict[int, Gap]:
        """Times between the ``parts`` of rows that come next, by index of the part that follows."""
        silences, last = dict[int, Gap](), self.until
        for i, rows in enumerate(parts):
            if rows is None:
                continue
            start = float(rows.index[0]) * STEP
            if last is not None and start - last > STEP / 2:
                silences[i] = last, start
            last = float(rows.index[-1] + 1) * STEP
        return silences

    def add(self, parts: Sequence[Rows], silent: int) -> None:
        """Count the usable rows of ``parts``, note the times of the others; ``silent`` rows were left out so far."""
        if silent:
            self.unusable[SILENT] = silent
        begun = [i for i, rows in enumerate(parts) if i == 0 or rows.index[0] > parts[i - 1].index[-1] + 1]
        for i, end in pairwise([*begun, len(parts)]):
            first = float(parts[i].index[0]) * STEP
            if self.until is not None and first - self.until > STEP / 2:
                self._note(self.until, first)
            self._add_run(parts[i:end])
            self.until = float(parts[end - 1].index[-1] + 1) * STEP

    def _add_run(self, parts: Sequence[Rows]) -> None:
        """Count the usable rows of one run without a gap, and note the times of the others."""
        self.switches.feed(parts)
        speed = np.isfinite(np.concatenate([rows.speed for rows in parts]))
        power = np.isfinite(np.concatenate([rows.power for rows in parts]))
        fresh = np.concatenate([rows.fresh for rows in parts])
        self.valid += int((speed & power).sum())
        self.unusable += Counter({"speed not known": int((~speed).sum()), "power not known": int((~power).sum())})
        stale = np.concatenate([[False], ~fresh.all(axis=1), [False]])
        edges = np.flatnonzero(np.diff(stale)).reshape(-1, 2)
        for start, end in ((parts[0].index[0] + edges) * STEP).tolist():
            self._note(start, end)

    def _note(self, start: float, end: float) -> None:
        if self.gaps and start - self.gaps[-1][1] < STEP:
            start = self.gaps.pop()[0]
        self.gaps.append((start, end))
