"""A full bus: frames of simulated drives, padded with unknown messages, sent at the pace of the bus."""

import json
import socket
import sys
import time
from dataclasses import asdict, dataclass, replace

import numpy as np
from can.typechecking import CanFilter
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from full_bus.loopback import HOST

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the class-8 tractor of Miller, Konan and Duran
METRES_PER_SECOND = 33.0  # of road, more than any truck drives
BUS_LOAD = {250: 1908, 500: 3817}  # frames/s of 8 bytes with 29-bit ids that fill a bus of so many kbit/s
UNKNOWN = 0x18FF8000  # proprietary B, in none of the project's databases
UNKNOWN_IDS = 64
PACE = 0.002  # s between bursts: no frame is late by more


@dataclass(frozen=True, slots=True)
class Sent:
    """Result of sending."""

    frames: int
    seconds: float


def drive(seconds: float, seed: int) -> Frames:
    """Frames of a drive of the truck, times from 0 [s]."""
    rng = np.random.default_rng(seed)
    route = generate_route("mixed", seconds * METRES_PER_SECOND, rng)
    frames = frames_of(record(TRUCK, route, seconds, rng).signals)
    return replace(frames, t=frames.t - frames.t[0])


def padded(frames: Frames, rate: float, rng: np.random.Generator) -> Frames:
    """``frames`` with as many unknown ones between them as make ``rate`` [frames/s]."""
    span = float(frames.t[-1])
    count = max(0, round(rate * span) - len(frames))
    ident = UNKNOWN | EXTENDED | rng.integers(0, UNKNOWN_IDS, count) << 8
    data = rng.integers(0, 256, (count, CLASSIC_BYTES), dtype=np.uint8)
    length = np.full(count, CLASSIC_BYTES, np.uint8)
    noise = Frames(np.sort(rng.uniform(0, span, count)), ident.astype(np.uint32), length, data)
    both = Frames.concatenate([frames, noise])
    return both[np.argsort(both.t, kind="stable")]


def passed(frames: Frames, filters: list[CanFilter]) -> Frames:
    """Frames that pass these kernel filters."""
    wanted: NDArray[np.bool_] = np.zeros(len(frames), bool)
    for one in filters:
        whole = one["can_id"] | (EXTENDED if one.get("extended") else 0)
        wanted |= (frames.ident ^ whole) & (one["can_mask"] | EXTENDED) == 0
    return frames[wanted]


def send(frames: Frames, port: int) -> Sent:
    """Send each frame at its time."""
    packed = np.zeros(len(frames), np.dtype([("ident", "=u4"), ("length", "u1"), ("pad", "u1", 3), ("data", "u1", 8)]))
    packed["ident"], packed["length"], packed["data"] = frames.ident, frames.length, frames.data
    raw = packed.tobytes()
    begun = time.monotonic()
    due = np.searchsorted(frames.t, np.arange(PACE, float(frames.t[-1]) + 2 * PACE, PACE), side="right").tolist()
    first = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect((HOST, port))
        for step, last in enumerate(due):
            time.sleep(max(0.0, begun + (step + 1) * PACE - time.monotonic()))
            for k in range(first, last):
                sender.send(raw[16 * k : 16 * k + 16])
            first = last
    return Sent(first, time.monotonic() - begun)


def main(path: str, port: str) -> None:
    """Send the frames of an .npz file and print the result."""
    with np.load(path) as file:
        frames = Frames(**file)
    print(json.dumps(asdict(send(frames, int(port)))))


if __name__ == "__main__":
    main(*sys.argv[1:])
