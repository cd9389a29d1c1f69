"""Rides as bicycle computers write them: FIT and TCX files of speed, power and altitude, a row a second."""

import struct
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

EPOCH = datetime(1989, 12, 31, tzinfo=UTC)  # of FIT
START = datetime(2026, 5, 4, 6, tzinfo=UTC)
RECORD = 20  # number of the message
FIELDS = ((253, 4, 0x86), (6, 2, 0x84), (7, 2, 0x84), (2, 2, 0x84))  # time, speed, power, altitude: number, size, type
NIBBLES = (  # of the polynomial 0xA001
    *(0x0000, 0xCC01, 0xD801, 0x1400, 0xF001, 0x3C00, 0x2800, 0xE401),
    *(0xA001, 0x6C00, 0x7800, 0xB401, 0x5000, 0x9C01, 0x8801, 0x4400),
)
Rows = Sequence[tuple[float, float, float, float]]  # s, m/s, W, m


def checksum(data: bytes) -> int:
    """CRC-16 of FIT, four bits at a time."""
    crc = 0
    for byte in data:
        for nibble in (byte & 15, byte >> 4):
            crc = crc >> 4 & 0xFFF ^ NIBBLES[crc & 15] ^ NIBBLES[nibble]
    return crc


def fit(rows: Rows) -> bytes:
    """A FIT file with one record a row."""
    body = struct.pack("<BBBHB", 0x40, 0, 0, RECORD, len(FIELDS)) + b"".join(bytes(field) for field in FIELDS)
    start = int((START - EPOCH).total_seconds())
    for t, speed, power, altitude in rows:
        body += struct.pack(
            "<BIHHH", 0, start + round(t), round(1000 * speed), round(power), round(5 * (altitude + 500))
        )
    head = struct.pack("<BBHI4s", 14, 0x10, 2132, len(body), b".FIT")
    whole = head + struct.pack("<H", checksum(head)) + body
    return whole + struct.pack("<H", checksum(whole))


def tcx(rows: Rows) -> str:
    """A TCX file with one track point a row."""
    points = "".join(
        f"<Trackpoint><Time>{(START + timedelta(seconds=t)).isoformat()}</Time>"
        f"<AltitudeMeters>{altitude}</AltitudeMeters>"
        f"<Extensions><ns3:TPX><ns3:Speed>{speed}</ns3:Speed><ns3:Watts>{power}</ns3:Watts></ns3:TPX></Extensions>"
        "</Trackpoint>\n"
        for t, speed, power, altitude in rows
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<TrainingCenterDatabase '
        'xmlns="http://www.garmin.com/xmlschemas/TrainingCenterDatabase/v2" '
        'xmlns:ns3="http://www.garmin.com/xmlschemas/ActivityExtension/v2"><Activities><Activity Sport="Biking">'
        f"<Lap><TotalTimeSeconds>1</TotalTimeSeconds><Track>{points}</Track></Lap></Activity></Activities>"
        "</TrainingCenterDatabase>\n"
    )


def written(content: bytes | str, path: Path) -> Path:
    """A file of that content."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path
