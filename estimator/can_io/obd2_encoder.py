"""Encoding of polled signals as OBD-II answers (ISO 15765-4), in the layout of the shipped database."""

import numpy as np

from estimator import config
from estimator.can_io.binding import bind, load_database
from estimator.can_io.frames import CLASSIC_BYTES, Frames
from estimator.can_io.obd import CURRENT_DATA, STANDARD
from estimator.signals import Role, Signals

EPOCH = 1_700_000_000.0  # s, time of the first moment of every recording
FILLER = 0xAA  # of the bytes that an answer does not need
HEAD_BYTES = 3  # length, service, PID


def frames_of(signals: Signals) -> Frames:
    """Answers of the first ECU, in order of time; times of ``signals`` are from the start of the drive [s].

    Values are rounded to the resolution of their PIDs; roles without a PID are left out.
    """
    shipped = config.load("obd2")
    (message,) = bind(shipped, load_database(shipped.bus.dbc))
    parts = []
    for bound in message.signals:
        if (series := signals.get(Role(bound.role))) is None:
            continue
        signal, conversion = bound.signal, bound.conversion
        physical = (series.value - conversion.offset) / conversion.scale
        size, (pid,) = signal.length // 8, signal.multiplexer_ids or (0,)
        raw = np.clip(np.round((physical - signal.offset) / signal.scale), 0, (1 << signal.length) - 1).astype(">u2")
        data = np.full((len(raw), CLASSIC_BYTES), FILLER, np.uint8)
        data[:, :HEAD_BYTES] = HEAD_BYTES - 1 + size, CURRENT_DATA, pid
        data[:, HEAD_BYTES : HEAD_BYTES + size] = raw.view(np.uint8).reshape(-1, 2)[:, 2 - size :]
        ident, length = np.full(len(raw), STANDARD, np.uint32), np.full(len(raw), CLASSIC_BYTES, np.uint8)
        parts.append(Frames(EPOCH + series.t, ident, length, data))
    frames = Frames.concatenate(parts)
    return frames[np.argsort(frames.t, kind="stable")]
