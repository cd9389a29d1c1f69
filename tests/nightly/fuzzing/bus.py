"""Spoilt traffic through the daemon's link, loop and estimator, on a clock that the traffic sets."""

import math
from collections.abc import Callable

import can
import numpy as np
from stepped_daemon import PlayedTraffic, link_to, turn

from estimator.answers.answer import encode
from estimator.can_io.binding import bind, load_database
from estimator.can_io.frames import EXTENDED, Frames
from estimator.config import from_dict
from estimator.daemon.service import metrics
from estimator.daemon.service.faults import Faults
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.worker import Worker
from estimator.daemon.transmitter import Transmitter
from estimator.streaming.pipeline import Pipeline
from fuzzing.formats import drive

PIECE, LOOK = 200, 50  # frames at a time; pieces between two looks at the status
PACE = 0.25  # s for a piece
WALL = 1_700_000_000.0  # s, wall time of the start
MAX_STATUS, MAX_REASONS = 1 << 16, 3  # bytes of a status; kinds of reasons to withhold
SPOILT = 0.3  # share of the frames of a drive that are spoilt
KNOWN = (0x18FEF100, 0x0CF00400, 0x18FEDF00, 0x18FEE300, 0x0CF00203, 0x18FEE81C)  # what a drive sends
SESSIONS = (0x1CECFF00, 0x1CEBFF00, 0x1CECFB00, 0x1CEBFB00)  # connections and packets, to all and to us
MANAGEMENT = (0x18EEFF00, 0x18EAFFF9, 0x18EAFBF9, 0x18FECA00, 0x18FED8F9, 0x18FF6000)  # claims, requests, our groups
STAMPS = (math.nan, math.inf, -math.inf, 1e300, 0.0, -1.0, 1e17)


class Noise(PlayedTraffic):
    """Spoilt traffic without end."""

    def __init__(self, seed: int) -> None:
        super().__init__(WALL)
        self.frames = 0
        self._rng = np.random.default_rng(seed)
        self._drive = drive(60.0)

    def next_piece(self) -> Frames:
        """The next frames."""
        self.now += PACE
        self.frames += PIECE
        makers: tuple[Callable[[], Frames], ...] = (self._driven, self._driven, self._forged, self._anything)
        frames = makers[int(self._rng.integers(len(makers)))]()
        t = np.sort(self.wall() + self._rng.uniform(-PACE, 0.0, PIECE))
        odd = self._rng.random(PIECE) < 0.002
        t[odd] = self._rng.choice(STAMPS, int(odd.sum()))
        return Frames(t, frames.ident, frames.length, frames.data)

    def _driven(self) -> Frames:
        """Frames of a drive, some of them spoilt."""
        first = int(self._rng.integers(len(self._drive) - PIECE))
        part = self._drive[first : first + PIECE]
        bad = self._rng.random(part.data.shape) < SPOILT / 8
        data = np.where(bad, self._rng.integers(0, 256, part.data.shape, dtype=np.uint8), part.data)
        length = np.where(self._rng.random(PIECE) < 0.02, self._rng.integers(0, 9, PIECE), part.length)
        return Frames(part.t, part.ident, length.astype(np.uint8), data)

    def _forged(self) -> Frames:
        """Known groups, sessions and management from any address, with any data."""
        base = self._rng.choice(np.array([*KNOWN, *SESSIONS * 3, *MANAGEMENT], np.uint32), PIECE)
        ident = (base + self._rng.integers(0, 256, PIECE)).astype(np.uint32) | np.uint32(EXTENDED)
        data = self._rng.integers(0, 256, (PIECE, 8), dtype=np.uint8)
        data[::2, 0] = self._rng.choice(np.array([16, 17, 19, 32, 255, 1, 2, 3], np.uint8), len(data[::2]))
        return Frames(np.zeros(PIECE), ident, np.full(PIECE, 8, np.uint8), data)

    def _anything(self) -> Frames:
        ident = self._rng.integers(0, 2**32, PIECE, dtype=np.uint32) & np.uint32(0x9FFFFFFF)
        data = self._rng.integers(0, 256, (PIECE, 8), dtype=np.uint8)
        return Frames(np.zeros(PIECE), ident, self._rng.integers(0, 9, PIECE).astype(np.uint8), data)


def spoilt_traffic(count: int, seed: int) -> str:
    """Turn the daemon on ``count`` spoilt frames; what became of them, in a line.

    Raises
    ------
    Exception
        Of any kind where the daemon ended.
    """
    noise, sent = Noise(seed), 0

    class Bus(can.BusABC):
        def __init__(self) -> None:
            super().__init__("fuzz")

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            nonlocal sent
            sent += 1

    config = from_dict({"transmit": {"enabled": True}})
    link = link_to(noise, config.reception, Bus)
    worker = Worker(Pipeline(config, is_live=True), config.reception.queue_frames, clock=noise.clock)
    transmitter = Transmitter(config.publish, config.transmit, link.send, np.random.default_rng(seed))
    faults = Faults(bind(config, load_database([])), config.publish.stale_after_s)
    daemon = Daemon(
        *(link, None, worker, transmitter, 5.0),
        clock=noise.clock,
        wall=noise.wall,
        own_faults=faults,
    )
    pieces = 0
    while noise.frames < count:
        turn(link, daemon, worker)
        pieces += 1
        if pieces % LOOK == 0:
            check(daemon, noise.now)
    seconds, per_second = noise.now, sent / noise.now
    return f"bus: {noise.frames:,} frames in {seconds:,.0f} s of their time, {per_second:.1f} frames/s sent; no fault"


def check(daemon: Daemon, now: float) -> None:
    """What holds whatever is on the bus: a bounded status, no estimate that is none, few reasons."""
    status = daemon.status(now)
    assert len(encode(status)) < MAX_STATUS
    assert metrics.exposition(status)
    assert len(status.transmit.withheld) <= MAX_REASONS
    estimate = daemon.worker.latest
    known = [] if estimate is None else [one for one in (estimate.mass, estimate.A, estimate.C) if one is not None]
    assert all(math.isfinite(one.mean) and one.sd > 0 for one in known)
