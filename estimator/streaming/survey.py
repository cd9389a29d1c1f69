"""Search of a log for candidate signals of a database: rate of their messages, and whether their values change."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator.can_io.binding import BoundMessage, BoundSignal, bound_message, last_byte
from estimator.can_io.decoder import is_group, is_message, stacked
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.iso_tp import IsoTp, is_segmented
from estimator.can_io.j1939 import GROUP_MASK, Transport, pgn_of
from estimator.can_io.role_candidates import Candidate
from estimator.can_io.signal_values import present, values
from estimator.config import Config, from_dict
from estimator.signals import DIMENSION, STATE
from estimator.streaming.log_frames import LogFrames, Progress, no_progress
from estimator.units import Conversion, conversion_of

MIN_CHANGES = 10  # of a value that is alive: fewer are start and end


@dataclass(slots=True, kw_only=True)
class Presence:
    """Statistics of the readings of one candidate in a log; values in SI."""

    readings: int = 0
    known: int = 0  # of them with a value
    changes: int = 0
    first: float = np.inf  # [s]
    last: float = -np.inf
    minimum: float = np.inf
    maximum: float = -np.inf

    @property
    def rate(self) -> float:
        """Rate of readings [Hz] from the first to the last; 0 if there are fewer than two."""
        return (self.readings - 1) / (self.last - self.first) if self.last > self.first else 0.0

    @property
    def is_alive(self) -> bool:
        """True if the value changes at least MIN_CHANGES times."""
        return self.changes >= MIN_CHANGES


@dataclass(frozen=True, slots=True)
class Survey:
    """Presences by MESSAGE.signal; ``is_by_group`` if most messages match by their parameter group alone."""

    presences: dict[str, Presence]
    is_by_group: bool


def survey(path: Path, candidates: Iterable[Candidate], progress: Progress = no_progress) -> Survey:
    """Read a log and count the readings of each candidate.

    Raises
    ------
    LogError
        The log cannot be read.
    """
    config = from_dict({"signals": {"speed": "X.x"}})  # no message: frames of all are wanted
    chosen = {candidate.path: candidate for candidate in candidates}
    presences = {path: Presence() for path in chosen}
    messages = [_bound(candidate, config) for candidate in chosen.values()]
    joiners = {path: IsoTp(message) for path, message in zip(chosen, messages, strict=True) if is_segmented(message)}
    last: dict[str, float] = {}  # latest value
    by_id, by_group = set[str](), set[str]()
    for frames in _with_joined(LogFrames([path], config, progress), messages):
        group = frames.ident & np.uint32(GROUP_MASK)
        for message in messages:
            path_of_it = f"{message.name}.{message.signals[0].signal.name}"
            mask = is_message(message, frames.ident, group)
            if mask.any():
                by_id.add(message.name)
                joiner = joiners.get(path_of_it)
                sent = frames[mask] if joiner is None else joiner.feed(frames[mask])
                _add(presences[path_of_it], message, message.signals[0], sent, last)
            elif not message.by_pgn and message.key & EXTENDED:
                pgn = int(pgn_of(np.array([message.key], dtype=np.uint32))[0])
                if is_group(pgn, group).any():
                    by_group.add(message.name)
    return Survey(
        {path: there for path, there in presences.items() if there.readings}, len(by_group - by_id) > len(by_id)
    )


def _with_joined(logs: Iterable[Frames], messages: Iterable[BoundMessage]) -> Iterator[Frames]:
    """The frames, and after them the messages of more than 8 bytes that the transport protocol of J1939 carries."""
    transport = Transport()
    signals = [
        signal for message in messages for bound in message.signals for signal in (bound.signal, *bound.multiplexers)
    ]
    reach = max(map(last_byte, signals), default=0)
    for frames in logs:
        yield frames
        if packets := transport.feed(frames):
            yield stacked(packets, reach)


def _bound(candidate: Candidate, config: Config) -> BoundMessage:
    """Message of a candidate with its signal alone bound."""
    by_name = {signal.name: signal for signal in candidate.message.signals}
    chain = []
    signal = candidate.signal
    while signal.multiplexer_signal in by_name and by_name[signal.multiplexer_signal] not in chain:
        signal = by_name[signal.multiplexer_signal]
        chain.append(signal)
    dimension = DIMENSION[candidate.role]
    conversion = (
        Conversion(STATE, 1.0) if dimension == STATE else conversion_of(candidate.unit or candidate.signal.unit)
    )
    assert conversion is not None
    bound = BoundSignal(role=candidate.role, signal=candidate.signal, conversion=conversion, multiplexers=tuple(chain))
    return bound_message(candidate.message, (bound,), config)


def _add(presence: Presence, message: BoundMessage, bound: BoundSignal, frames: Frames, last: dict[str, float]) -> None:
    """Count the readings of a signal in frames of its message."""
    need = max(last_byte(signal) for signal in (bound.signal, *bound.multiplexers))
    if need > frames.data.shape[1]:
        return
    frames = frames[frames.length >= need]
    frames = frames[present(bound, frames)]
    if not len(frames):
        return
    value, _ = values(message, bound, frames)
    finite = value[np.isfinite(value)]
    presence.readings += len(value)
    presence.first, presence.last = min(presence.first, float(frames.t[0])), max(presence.last, float(frames.t[-1]))
    if len(finite):
        path = f"{message.name}.{bound.signal.name}"
        presence.known += len(finite)
        presence.changes += int(np.count_nonzero(np.diff(finite, prepend=last.get(path, finite[0]))))
        last[path] = float(finite[-1])
        presence.minimum, presence.maximum = (
            min(presence.minimum, float(finite.min())),
            max(presence.maximum, float(finite.max())),
        )
