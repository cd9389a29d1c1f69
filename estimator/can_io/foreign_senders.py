"""Detection of other senders of the broadcast groups: frames of two senders with one id collide on the bus."""

from collections.abc import Iterable

import numpy as np

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import pgn_of

CVW = 0xFE70  # 65136, combination vehicle weight: SAE's own, so its receivers take it from any address
CVW_HOLD = 3600.0  # s without a CVW after which its sender no longer counts: it may send on request only
COLLISION_HOLD = 60.0  # s without a frame with our id after which we send again: one copied frame stops us briefly


class ForeignSenders:
    """Records which of the groups ``pgns`` other nodes send; takes frames of other nodes only."""

    def __init__(self, pgns: Iterable[int]) -> None:
        self._pgns = np.array(sorted({*pgns, CVW}), dtype=np.uint32)
        self._heard: dict[tuple[int, int], float] = {}  # time [s] by group and source address

    def watch(self, frames: Frames) -> None:
        """Take frames of other nodes on the bus."""
        pgn = pgn_of(frames.ident)
        ours = np.flatnonzero(np.isin(pgn, self._pgns) & (frames.ident & EXTENDED != 0))
        for i in ours.tolist():
            self._heard[int(pgn[i]), int(frames.ident[i] & 0xFF)] = float(frames.t[i])

    def senders(self, pgn: int, t: float) -> list[int]:
        """Source addresses from which others recently sent a group, at time ``t`` [s]."""
        hold = CVW_HOLD if pgn == CVW else COLLISION_HOLD
        return sorted(
            source for (group, source), heard in self._heard.items() if group == pgn and abs(t - heard) < hold
        )

    def is_occupied(self, pgn: int, source: int, t: float) -> bool:
        """True if another node uses the id of a group from address ``source`` at time ``t`` [s], so we must not send.

        For the CVW, a sender at any address is enough: a vehicle has one weight.
        """
        senders = self.senders(pgn, t)
        return bool(senders) if pgn == CVW else source in senders
