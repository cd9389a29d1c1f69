"""Kill the daemon's loop at random times and check its state file: python tests/nightly/power_loss.py --kills 1000.

A child process turns the daemon's link, loop and worker on a clock that the traffic of a simulated drive sets, as fast
as it can, and saves its state every few seconds of driving. It is killed by SIGKILL: every other child at a random
time, the others while they write their state. The state file is read and checked, and the next child continues from
it, at a random later time of the drive. Exit status 1 if more driving was lost than the interval and BLOCKS, or a state
was damaged.
"""

import argparse
import json
import logging
import mmap
import os
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from stepped_daemon import PlayedTraffic, link_to, turn

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.checkpoint.store import StateStore, pack
from estimator.config import Config
from estimator.daemon.service.assembly import restored
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.worker import Worker
from estimator.errors import StateError
from estimator.roles import Role
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
KEY = "power loss"
PIECE = 1.0  # s of driving read at a time
INTERVAL = 5.0  # s of driving between saves
BLOCKS = 10.0  # s of driving that wait in blocks, and are in no state yet (docs/gateway.md, State)
MOVING = 1.0  # m/s; a vehicle at rest adds nothing to save
MAX_LIFE = 60.0  # s of driving until a child is killed
MAX_WAIT = 60.0  # s for a child to drive or to write
LOOK = 0.002  # s, the longest time between two looks at a child
MAX_OUTAGE = 20.0  # s of driving between two children, not recorded
BREAK = 60.0  # s between two laps of the same drive
LAST = 1500.0  # s driven after the last cut, for a last estimate
COUNTS = ("failed", "while_saving", "leftovers", "previous_used", "lost", "corrupt")


class Drive:
    """A drive that is repeated at later and later times."""

    def __init__(self, minutes: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        signals = record(TRUCK, generate_route("mixed", 1500 * minutes, rng), 60 * minutes, rng).signals
        self._frames, speed = frames_of(signals), signals[Role.SPEED]
        self.epoch = float(self._frames.t[0])  # [s] of the first frame
        self._lap = float(self._frames.t[-1] - self.epoch) + BREAK
        grid = np.arange(0.0, self._lap, PIECE)
        self._is_moving = np.interp(grid, speed.t - speed.t[0], speed.value, right=0.0) > MOVING

    def between(self, start: float, stop: float) -> Frames:
        """Frames from ``start`` to ``stop`` seconds of driving."""
        parts = []
        for lap in range(int(start // self._lap), int(stop // self._lap) + 1):
            t = self._frames.t - self._frames.t[0] + lap * self._lap
            first, last = np.searchsorted(t, [start, stop])
            part = self._frames[int(first) : int(last)]
            parts.append(replace(part, t=part.t + lap * self._lap))
        return Frames.concatenate(parts)

    def moving(self, start: float, stop: float) -> float:
        """Seconds of driving from ``start`` to ``stop`` in which the vehicle moves."""
        pieces = np.arange(start, stop, PIECE) % self._lap // PIECE
        return PIECE * int(self._is_moving[pieces.astype(int)].sum())


class Traffic(PlayedTraffic):
    """The drive from ``start`` [s] on, as a child has it."""

    def __init__(self, drive: Drive, start: float, witness: "Witness") -> None:
        super().__init__(drive.epoch, start)
        self._drive, self._witness = drive, witness

    def next_piece(self) -> Frames:
        """The next second of driving."""
        frames = self._drive.between(self.now, self.now + PIECE)
        self.now += PIECE
        self._witness[DRIVEN] = self.now
        return frames


class WitnessedStore(StateStore):
    """A store that says when it writes, and puts the time of driving into the state."""

    def __init__(self, directory: Path, traffic: Traffic, witness: "Witness") -> None:
        super().__init__(directory)
        self._traffic, self._witness = traffic, witness

    def save(self, state: Mapping[str, Any], key: str) -> None:
        """Write a state as the daemon does."""
        began = time.monotonic()
        self._witness[SAVING] = self._traffic.now
        super().save({**state, "at": self._traffic.now}, key)
        self._witness[SAVED] = self._traffic.now
        self._witness[WRITING] = time.monotonic() - began


class Witness:
    """Progress of a child in shared memory: seconds driven, being saved, and saved; and how long the write took [s]."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, 32)
        self[WRITING] = FIRST_WRITING

    def __getitem__(self, i: int) -> float:
        value: float = struct.unpack_from("d", self._memory, 8 * i)[0]
        return value

    def __setitem__(self, i: int, value: float) -> None:
        struct.pack_into("d", self._memory, 8 * i, value)


DRIVEN, SAVING, SAVED, WRITING = range(4)
FIRST_WRITING = 0.005  # s, before one was measured


def live(drive: Drive, directory: Path, config: Config, witness: Witness, start: float) -> None:
    """Main function of a child: the daemon, its threads turned in one loop."""
    traffic = Traffic(drive, start, witness)
    store = WitnessedStore(directory, traffic, witness)
    link = link_to(traffic, config.reception)
    worker = Worker(
        restored(config, store, KEY), config.reception.queue_frames, store, KEY, INTERVAL, clock=traffic.clock
    )
    files = (directory / "status.json", directory / "metrics")
    daemon = Daemon(
        link, None, worker, None, config.reception.silence_s, *files, clock=traffic.clock, wall=traffic.wall
    )
    while True:
        turn(link, daemon, worker)


def has_ended(child: int) -> bool:
    """Whether the child ended by itself."""
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def wait_for_driving(witness: Witness, child: int, until: float, rng: np.random.Generator) -> None:
    """Return at a random time after the child has driven to ``until`` [s], however slow the machine is."""
    deadline = time.monotonic() + MAX_WAIT
    while witness[DRIVEN] < until and time.monotonic() < deadline and not has_ended(child):
        time.sleep(rng.uniform(0, LOOK))


def stop_in_write(witness: Witness, child: int, rng: np.random.Generator) -> None:
    """Stop the child at a random time of a write of its state; a write that ended before it stopped does not count."""
    deadline = time.monotonic() + MAX_WAIT
    while time.monotonic() < deadline:
        while witness[SAVING] <= witness[SAVED] and time.monotonic() < deadline:
            if has_ended(child):
                return
        time.sleep(rng.uniform(0, witness[WRITING]))
        os.kill(child, signal.SIGSTOP)
        os.waitid(os.P_PID, child, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        if witness[SAVING] > witness[SAVED]:
            return
        os.kill(child, signal.SIGCONT)


def cut(drive: Drive, directory: Path, config: Config, kills: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill ``kills`` children, one after the other, and count the states found."""
    witness, counts, losses = Witness(), dict.fromkeys(COUNTS, 0), [0.0]
    begin, frames, mass = 0.0, 0, float("nan")
    for kill in range(kills):
        child = os.fork()
        if child == 0:
            try:
                live(drive, directory, config, witness, begin)
            finally:
                os._exit(70)  # reached only after an error: a child runs until it is killed
        if kill % 2:
            stop_in_write(witness, child, rng)
        else:
            wait_for_driving(witness, child, begin + rng.uniform(0, MAX_LIFE), rng)
        os.kill(child, signal.SIGKILL)
        counts["failed"] += os.WIFEXITED(os.waitpid(child, 0)[1])
        counts["while_saving"] += witness[SAVING] > witness[SAVED]
        counts["leftovers"] += any(directory.glob("state*.part"))
        state, reason = StateStore(directory).load(KEY)
        counts["previous_used"] += "previous state is used" in reason
        if state is None:
            counts["lost"] += witness[SAVED] > 0
        else:
            pipeline = Pipeline(config)
            try:
                pipeline.restore(state)
            except StateError:
                counts["corrupt"] += 1
            if state["at"] not in (witness[SAVED], witness[SAVING]) or pipeline.traffic.frames < frames:
                counts["corrupt"] += 1
            # Driving of this child before its first save and after its last.
            losses.append(drive.moving(max(state["at"], begin), witness[DRIVEN]))
            frames = pipeline.traffic.frames
            witness[SAVING] = witness[SAVED] = state["at"]
        begin = max(witness[DRIVEN], begin) + rng.uniform(0, MAX_OUTAGE)
    if state is not None:
        *_, estimate = pipeline.feed(drive.between(begin, begin + LAST))
        mass = estimate.mass.mean if estimate.mass else mass
    return {
        "kills": kills,
        **counts,
        "longest_loss_s": max(losses),
        "driven_s": begin,
        "mass_error": mass / TRUCK.mass - 1,
        "state_bytes": len(pack(state or {}, KEY)),
    }


def main() -> int:
    """Run the test, print the counts, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=20.0, help="length of the simulated drive")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    logging.disable()  # every child says that it runs
    drive = Drive(arguments.minutes, arguments.seed)
    with tempfile.TemporaryDirectory() as directory:
        rng = np.random.default_rng(arguments.seed)
        found = cut(drive, Path(directory), Config(), arguments.kills, rng)
    if arguments.json:
        print(json.dumps(found))
    else:
        print("\n".join(f"{name.replace('_', ' '):16} {value:.6g}" for name, value in found.items()))
    bad = found["lost"] + found["corrupt"] + found["failed"]
    return int(bad > 0 or found["longest_loss_s"] > INTERVAL + BLOCKS)


if __name__ == "__main__":
    sys.exit(main())
