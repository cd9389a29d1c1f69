"""Batches of CAN frames as arrays, as read from logs and from the bus."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats

EXTENDED = 1 << 31  # set in `ident` for a 29-bit id, as SocketCAN does (CAN_EFF_FLAG)
CLASSIC_BYTES = 8  # payload of a classic CAN frame
FD_BYTES = 64  # payload of the longest CAN FD frame
JOINED_BYTES = 4095  # payload of the longest message that is joined from frames (ISO 15765-2)
FIRST_BYTES = np.array([(1 << 8 * n) - 1 for n in range(CLASSIC_BYTES + 1)], np.uint64)  # mask of n bytes of a payload


class UnchangedMessage(can.Message):
    """Message whose bytes nobody changes. Its copies share them: python-can's virtual bus copies what it delivers."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        return self.__copy__()


@dataclass(frozen=True, slots=True)
class Frames:
    """Data frames in order of arrival.

    ``t`` (n,) [s]; ``ident`` (n,) uint32 with bit 31 set for 29-bit ids; ``length`` (n,) payload bytes;
    ``data`` (n, 8) uint8, or wider when a longer payload is among them (64 for CAN FD), zero beyond ``length``.
    """

    t: Floats
    ident: NDArray[np.uint32]
    length: NDArray[np.unsignedinteger[Any]]
    data: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.intp]) -> "Frames":
        if isinstance(index, slice):
            return Frames(self.t[index], self.ident[index], self.length[index], self.data[index])
        rows = np.flatnonzero(index) if index.dtype == np.bool_ else index
        words = np.take(self.words, rows, axis=0)  # faster than byte by byte, and `take` than an index
        return Frames(self.t.take(rows), self.ident.take(rows), self.length.take(rows), words.view(np.uint8))

    def widened(self, size: int) -> "Frames":
        """Pad payloads with zeros to at least ``size`` bytes, in whole words."""
        width = -(-size // CLASSIC_BYTES) * CLASSIC_BYTES
        return self if self.data.shape[1] >= width else replace(self, data=widened(self.data, width))

    @property
    def words(self) -> NDArray[np.uint64]:
        """Payload as little-endian 64-bit numbers (n, width / 8)."""
        return np.ascontiguousarray(self.data).view("<u8")

    @classmethod
    def from_messages(cls, messages: Iterable[can.Message]) -> "Frames":
        """Pack python-can data messages; the caller has dropped error and remote frames."""
        rows = [
            (m.timestamp, m.arbitration_id | (EXTENDED if m.is_extended_id else 0), len(m.data), bytes(m.data))
            for m in messages
        ]
        width = FD_BYTES if any(row[2] > CLASSIC_BYTES for row in rows) else CLASSIC_BYTES
        payload = b"".join(row[3].ljust(width, b"\0") for row in rows)
        return cls(
            np.array([row[0] for row in rows], dtype=np.float64),
            np.array([row[1] for row in rows], dtype=np.uint32),
            np.array([row[2] for row in rows], dtype=np.uint8),
            np.frombuffer(payload, dtype=np.uint8).reshape(-1, width),
        )

    def messages(self) -> Iterator[can.Message]:
        """Convert to python-can messages, e.g. to send them on a bus."""
        ids = self.ident.tolist()
        times = self.t.tolist()
        lengths = self.length.tolist()
        width = self.data.shape[1]
        payload = self.data.tobytes()
        for i, ident in enumerate(ids):
            start = i * width
            yield UnchangedMessage(
                timestamp=times[i],
                arbitration_id=ident & ~EXTENDED,
                is_extended_id=bool(ident & EXTENDED),
                is_fd=lengths[i] > CLASSIC_BYTES,
                data=payload[start : start + lengths[i]],
            )

    @classmethod
    def concatenate(cls, parts: "list[Frames]") -> "Frames":
        """Join batches, widening payloads where a longer one is among them."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return cls(
                np.empty(0), np.empty(0, np.uint32), np.empty(0, np.uint8), np.empty((0, CLASSIC_BYTES), np.uint8)
            )
        width = max(part.data.shape[1] for part in parts)
        return cls(
            np.concatenate([part.t for part in parts]),
            np.concatenate([part.ident for part in parts]),
            np.concatenate([part.length for part in parts]),
            np.concatenate([widened(part.data, width) for part in parts]),
        )


def widened(data: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Pad payloads (n, m) with zeros to ``width`` bytes."""
    if data.shape[1] == width:
        return data
    wide = np.zeros((len(data), width), np.uint8)
    wide[:, : data.shape[1]] = data
    return wide
