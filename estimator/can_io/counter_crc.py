"""Alive counter and checksum of the broadcast frames, by which a receiver detects lost, repeated and damaged ones.

Byte 7, low nibble: counter 0 to 14, 15 = not available (as in AUTOSAR E2E profile 1).
Byte 8: CRC-8 SAE J1850 over the 29-bit id as four bytes, least significant first, and bytes 1 to 7. The id is part of
it, so that a frame under a wrong id, e.g. another source address, does not pass.
"""

import can

COUNTS = 15  # values of the alive counter, 0..14
LENGTH = 8  # bytes of a protected frame
_POLYNOMIAL = 0x1D  # SAE J1850: x^8 + x^4 + x^3 + x^2 + 1


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ _POLYNOMIAL if byte & 0x80 else byte << 1
    return byte & 0xFF


_TABLE = bytes(_remainder(byte) for byte in range(256))


def crc8(data: bytes) -> int:
    """CRC-8 SAE J1850 of ``data``: initial value and final XOR 0xFF; 0x4B for b"123456789"."""
    crc = 0xFF
    for byte in data:
        crc = _TABLE[crc ^ byte]
    return crc ^ 0xFF


def checksum(ident: int, payload: bytes) -> int:
    """Checksum of a frame with the 29-bit id ``ident`` and ``payload``, its bytes 1 to 7."""
    return crc8(ident.to_bytes(4, "little") + payload)


def verify(message: can.Message) -> bool:
    """Check that a received frame carries the checksum of its id and bytes 1 to 7.

    Parameters
    ----------
    message
        One of the ``Roadload...`` frames of ``roadload.dbc``; the CVW frame has no checksum.

    Returns
    -------
    bool
        False for a damaged frame, and for one that is not an 8-byte data frame with a 29-bit id.
    """
    data = bytes(message.data)
    return message.is_extended_id and len(data) == LENGTH and data[-1] == checksum(message.arbitration_id, data[:-1])
