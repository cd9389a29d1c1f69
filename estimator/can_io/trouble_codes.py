"""Diagnostic trouble codes of this node, as DM1 and DM2 carry them (SAE J1939-73).

DM1 and DM2: byte 1 lamps, byte 2 their flashing, then 4 bytes a code: SPN (19 bits, bits 1 to 16 first, 17 to 19 above
the FMI), FMI (5 bits), occurrence count (7 bits), SPN conversion method (0). One code fits one frame; several go by the
transport protocol. Without a code, bytes 3 to 6 are 0.

The lamps are always off: no fault of an estimate concerns the driver.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import IntEnum

DM1, DM2 = 0xFECA, 0xFECB  # 65226 active, 65227 previously active
DM3, DM11 = 0xFECC, 0xFED3  # 65228 clear the previously active, 65235 clear the active ones
LAMPS_OFF, NO_FLASH = 0x00, 0xFF  # J1939-73: 00 off; flashing 11 "do not flash"
CONFIRM_S = 10.0  # s for which a fault lasts before it is active: EC1 comes every 5 s
MAX_CODES = 20  # kept of each kind; 82 bytes, 12 packets, 0.6 s on the bus
MAX_COUNT = 126  # occurrences; 127 means not available
CODE_BYTES = 4
FRAME_BYTES = 8
MAX_SPN = (1 << 19) - 1


class Fmi(IntEnum):
    """Failure mode identifiers of J1939-73 that are used here."""

    ERRATIC = 2  # data erratic, intermittent or incorrect
    UPDATE_RATE = 9  # abnormal update rate
    BAD_DEVICE = 12  # bad intelligent device or component
    NETWORK_DATA = 19  # received network data in error


@dataclass(frozen=True, order=True)
class TroubleCode:
    """Faulty parameter (suspect parameter number) and kind of fault (failure mode identifier)."""

    spn: int
    fmi: int

    def __str__(self) -> str:
        return f"SPN {self.spn} FMI {self.fmi}"

    def encoded(self, count: int) -> bytes:
        """Encode in four bytes, with the occurrence count 0..127."""
        return (self.spn & 0xFFFF).to_bytes(2, "little") + bytes([self.spn >> 16 << 5 | self.fmi, count])

    @classmethod
    def decoded(cls, data: bytes) -> "tuple[TroubleCode, int]":
        """Decode a code and its occurrence count from four bytes."""
        return cls(int.from_bytes(data[:2], "little") | data[2] >> 5 << 16, data[2] & 0x1F), data[3] & 0x7F


class TroubleMemory:
    """Active and previously active codes.

    Attributes
    ----------
    active, previous
        Occurrence counts by code, the oldest first; at most MAX_CODES each.
    """

    def __init__(self) -> None:
        self.active: dict[TroubleCode, int] = {}
        self.previous: dict[TroubleCode, int] = {}
        self._since: dict[TroubleCode, float] = {}  # [s] when a fault was first seen, without a break

    def observe(self, present: Collection[TroubleCode], t: float) -> bool:
        """Take the faults at time ``t`` [s], which never decreases; returns True if the active codes changed."""
        previously_active = set(self.active)
        self._since = {code: self._since.get(code, t) for code in sorted(present)}
        for code in previously_active - set(present):
            self.previous[code] = self.active.pop(code)
        for code, since in self._since.items():
            if code not in self.active and t - since >= CONFIRM_S and len(self.active) < MAX_CODES:
                self.active[code] = min(MAX_COUNT, self.previous.pop(code, 0) + 1)
        self._shorten()
        return set(self.active) != previously_active

    def remember(self, codes: Iterable[tuple[TroubleCode, int]]) -> None:
        """Add codes of an earlier run as previously active."""
        self.previous = dict(codes) | self.previous
        self._shorten()

    def clear_previous(self) -> bool:
        """Delete the previously active codes; returns True if there were any."""
        had, self.previous = bool(self.previous), {}
        return had

    def clear_active(self) -> bool:
        """Delete the active codes; True if there were any. A lasting fault is active again after CONFIRM_S."""
        had, self.active, self._since = bool(self.active), {}, {}
        return had

    def message(self, pgn: int) -> bytes:
        """Payload of DM1 or DM2: 8 bytes, or 2 + 4 n for n > 1 codes."""
        codes = self.active if pgn == DM1 else self.previous
        content = b"".join(code.encoded(count) for code, count in codes.items()) or bytes(CODE_BYTES)
        return (bytes([LAMPS_OFF, NO_FLASH]) + content).ljust(FRAME_BYTES, b"\xff")

    def _shorten(self) -> None:
        for code in list(self.previous)[: max(0, len(self.previous) - MAX_CODES)]:
            del self.previous[code]


def codes_of(message: bytes) -> list[tuple[TroubleCode, int]]:
    """Codes in the payload of a DM1 or DM2, with their occurrence counts."""
    whole = (len(message) - 2) // CODE_BYTES
    parts = [message[2 + CODE_BYTES * i : 2 + CODE_BYTES * (i + 1)] for i in range(whole)]
    return [TroubleCode.decoded(part) for part in parts if part not in (bytes(CODE_BYTES), b"\xff" * CODE_BYTES)]
