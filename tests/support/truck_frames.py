"""Frames of a truck's database, put together by hand."""

import itertools

import can
import cantools

from estimator.can_io.frames import Frames


def cut(frames: Frames, places: list[int]) -> list[Frames]:
    edges = [0, *sorted(p % (len(frames) + 1) for p in places), len(frames)]
    return [frames[slice(a, b)] for a, b in itertools.pairwise(edges)]


def pack(*rows: tuple[float, int, bytes | str]) -> Frames:
    """Frames from (time, id, payload); ids of more than 11 bits are 29-bit ids."""
    return Frames.from_messages(
        can.Message(
            timestamp=t,
            arbitration_id=ident,
            is_extended_id=ident > 0x7FF,
            is_fd=len(data) > 8,
            data=data,
        )
        for t, ident, data in ((t, i, bytes.fromhex(d) if isinstance(d, str) else d) for t, i, d in rows)
    )


TRUCK = cantools.database.load_string(
    """VERSION ""
BS_:
BU_: X
BO_ 2566844926 BROADCAST: 8 X
 SG_ Fraction : 0|8@1+ (1,0) [0|0] "%" X
 SG_ Speed : 8|16@1+ (0.00390625,0) [0|0] "km/h" X
 SG_ Switch : 28|2@1+ (1,0) [0|3] "" X
 SG_ Gear : 32|4@1+ (1,0) [0|0] "" X
 SG_ Signed : 40|16@1- (1,0) [0|0] "Nm" X
BO_ 2363490302 ADDRESSED: 8 X
 SG_ Distance : 0|32@1+ (1,0) [0|0] "m" X
BO_ 2566841342 LARGE: 39 X
 SG_ Torque : 152|16@1+ (1,0) [0|0] "Nm" X
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
BA_ "VFrameFormat" BO_ 2566844926 3;
BA_ "VFrameFormat" BO_ 2363490302 3;
BA_ "VFrameFormat" BO_ 2566841342 3;
""",
    database_format="dbc",
)

BROADCAST, LARGE = 0x18FEF100, 0xFEE3

SPEED = {"signals": {"speed": "BROADCAST.Speed"}}


def broadcast(t: float, source: int, speed: int, switch: int = 3, fraction: int = 255) -> tuple[float, int, bytes]:
    data = bytes([fraction]) + speed.to_bytes(2, "little") + bytes([0xCF | switch << 4]) + b"\xff" * 4
    return t, BROADCAST | source, data


def announced(t: float, source: int, pgn: int, payload: bytes) -> list[tuple[float, int, bytes]]:
    """The frames of a multi-packet broadcast, 50 ms apart."""
    packets = -(-len(payload) // 7)
    start = b"\x20" + len(payload).to_bytes(2, "little") + bytes([packets, 0xFF]) + pgn.to_bytes(3, "little")
    padded = payload.ljust(7 * packets, b"\xff")
    return [(t, 0x1CECFF00 | source, start)] + [
        (t + 0.05 * (k + 1), 0x1CEBFF00 | source, bytes([k + 1]) + padded[7 * k : 7 * k + 7]) for k in range(packets)
    ]


TORQUE = {"signals": {"reference_torque": "LARGE.Torque"}}
