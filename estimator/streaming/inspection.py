"""Inspection of a log or bus: inputs found and missing, their rates and gaps, shares not available."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from estimator.answers.inspection import Busy, InspectionAnswer
from estimator.answers.inspection import Frames as FrameCounts
from estimator.answers.inspection import Input as InputAnswer
from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import pgn_of
from estimator.config import Config
from estimator.errors import MissingInputsError
from estimator.estimates import Estimate, Status
from estimator.signals import Floats, Role
from estimator.streaming.log_frames import LogFrames, Progress, no_progress
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block, Interruption

# Usual intervals without a reading that count as a gap. Chosen by hand: it holds for signals slower than 10 Hz, and
# changes the list of gaps alone.
MIN_GAP_PERIODS = 10.0
MIN_GAP = 1.0  # s: shorter gaps are not listed


@dataclass
class Input:
    """Readings of one bound signal in a log."""

    name: str
    times: list[Floats] = field(default_factory=list)
    values: list[Floats] = field(default_factory=list)

    def describe(self, end: float, start: float) -> InputAnswer:
        """Describe the readings, at least one, of a log from ``start`` to ``end`` [s]."""
        t, value = np.concatenate(self.times), np.concatenate(self.values)
        steps = np.diff(t)
        steps = steps[steps > 0]
        period = float(np.quantile(steps, 0.75)) if len(steps) else float("inf")  # frames may come in pairs
        finite = value[np.isfinite(value)]
        edges = np.append(t, end)
        longest = max(MIN_GAP_PERIODS * period, MIN_GAP)
        long, heard = np.diff(edges) > longest, steps[steps <= longest]
        return InputAnswer(
            signal=self.name,
            readings=len(t),
            rate_Hz=round(len(heard) / float(heard.sum()), 3) if len(heard) else None,
            not_available=round(1 - len(finite) / len(t), 6),
            minimum=float(finite.min()) if len(finite) else None,
            maximum=float(finite.max()) if len(finite) else None,
            gaps_s=tuple(
                (round(float(edges[i] - start), 3), round(float(edges[i + 1] - start), 3)) for i in np.flatnonzero(long)
            ),
        )


class Inspection:
    """Collects the inputs in traffic, batch by batch; `report` returns them."""

    def __init__(self, config: Config) -> None:
        messages = bound_messages(config)
        bound = sorted((s.role, s.place, f"{m.name}.{s.signal.name}") for m in messages for s in m.signals)
        self._several = {role for role, number, _ in bound if number > 0}
        self._inputs = {(role, number): Input(name) for role, number, name in bound}
        self._groups = {m.key: m.name for m in messages if m.by_pgn}
        self._pipeline = Pipeline(config)
        self._idents: Counter[int] = Counter()
        self._start = self._end = self._begun = 0.0  # [s] first and latest time, and start of the latest recording
        self._before = 0.0  # [s] that earlier recordings lasted
        self._final: Estimate | None = None

    def add(self, frames: Frames) -> None:
        """Take the next frames, in order of arrival."""
        for item in self._pipeline.traffic.feed(frames):
            self._take(item)

    def _take(self, item: Block | Interruption) -> None:
        for update in self._pipeline.take(item):
            self._final = update
        if isinstance(item, Block):
            self._count(item)
        elif item.is_step_back:
            self._before += self._end - self._begun
            self._begun = item.end

    def _count(self, block: Block) -> None:
        """Count the frames of a block and keep its readings."""
        if len(block.frames):
            if not self._idents:
                self._start = self._begun = float(block.frames.t[0])
            self._end = float(block.frames.t[-1])
        ids, counts = np.unique(block.frames.ident, return_counts=True)
        self._idents.update(dict(zip(ids.tolist(), counts.tolist(), strict=True)))
        for role, parts in block.readings.items():
            for number, part in enumerate(parts):
                if len(part.t):
                    self._inputs[role, number].times.append(part.t)
                    self._inputs[role, number].values.append(part.value)

    def report(self, source: str, skipped: Counter[str], mixed: Mapping[str, int] | None = None) -> InspectionAnswer:
        """Finish, and describe the traffic of ``source``, a log or bus; no frames can be added afterwards.

        ``skipped`` counts frames that were not read, by reason; ``mixed`` frames by channel, if read as one bus.
        """
        traffic = self._pipeline.traffic
        for item in traffic.finish():
            self._take(item)
        for update in self._pipeline.finish():
            self._final = update
        try:
            traffic.require_inputs(source)
            missing = ""
        except MissingInputsError as error:
            missing = str(error)
        final = None if missing else self._final
        return InspectionAnswer(
            log=source,
            duration_s=round(self._before + self._end - self._begun, 3),
            frames=FrameCounts(
                read=sum(self._idents.values()),
                ids=len(self._idents),
                used=traffic.used,
                reordered=traffic.order.reordered,
                steps_back=traffic.order.steps_back,
                errors=dict(skipped + traffic.errors),
                mixed_channels=dict(mixed or {}),
            ),
            sources=traffic.sources,
            contested=traffic.contested,
            senders=self._senders(),
            inputs={
                self._label(*key): x.describe(self._end, self._start) for key, x in self._inputs.items() if x.times
            },
            missing={self._label(*key): x.name for key, x in self._inputs.items() if not x.times},
            busiest=tuple(
                Busy(id=f"{ident & ~EXTENDED:0{8 if ident & EXTENDED else 3}X}", frames=count)
                for ident, count in self._idents.most_common(10)
            ),
            usable=not missing and (final is None or final.status is not Status.INVALID),
            status=Status.UNESTIMATED if final is None else final.status,
            reason=missing if final is None else final.reason,
            coverage=0.0 if final is None else final.coverage.fraction,
            warnings=tuple(traffic.remarks),
        )

    def _label(self, role: Role, number: int) -> str:
        return f"{role.value} {number + 1}" if role in self._several else role.value

    def _senders(self) -> dict[str, tuple[int, ...]]:
        """Source addresses that send each bound message in single frames, by message name."""
        idents = np.array([ident for ident in self._idents if ident & EXTENDED], dtype=np.uint32)
        addresses: dict[str, list[int]] = {}
        for ident, pgn in sorted(zip((idents & 0xFF).tolist(), pgn_of(idents).tolist(), strict=True)):
            if pgn in self._groups and ident not in addresses.setdefault(self._groups[pgn], []):
                addresses[self._groups[pgn]].append(ident)
        return {name: tuple(idents) for name, idents in addresses.items()}


def inspect(path: Path, config: Config, progress: Progress = no_progress) -> InspectionAnswer:
    """Describe one log. Missing inputs are no error; unreadable content is.

    Raises
    ------
    LogError
        The log cannot be read.
    """
    inspection, logs = Inspection(config), LogFrames([path], config, progress)
    for frames in logs:
        inspection.add(frames)
    return inspection.report(str(path), logs.skipped, logs.mixed)
