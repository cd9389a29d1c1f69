"""Kill an estimator at random times and check its state file: python tools/power_loss.py --kills 1000.

A child process feeds a simulated drive through the pipeline as fast as it can and saves its state every few seconds
of driving. It is killed by SIGKILL at a random time; its state file is read and checked, and the next child continues
from it, at a random later time of the drive. Exit status 1 if a state was older than the interval or damaged.
"""

import argparse
import json
import mmap
import os
import signal
import struct
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.checkpoint.store import StateStore, pack
from estimator.config import Config
from estimator.errors import StateError
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
KEY = "power loss"
PIECE = 1.0  # s of driving fed at a time
INTERVAL = 5.0  # s of driving between saves
MAX_LIFE = 0.06  # s until a child is killed
MAX_OUTAGE = 20.0  # s of driving between two children, not recorded
BREAK = 60.0  # s between two laps of the same drive
LAST = 1500.0  # s driven after the last cut, for a last estimate
COUNTS = ("failed", "while_saving", "leftovers", "previous_used", "lost", "corrupt")


class Drive:
    """A drive that is repeated at later and later times."""

    def __init__(self, minutes: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._frames = frames_of(record(TRUCK, generate_route("mixed", 1500 * minutes, rng), 60 * minutes, rng).signals)
        self._lap = float(self._frames.t[-1] - self._frames.t[0]) + BREAK

    def between(self, start: float, stop: float) -> Frames:
        """Frames from ``start`` to ``stop`` seconds of driving."""
        parts = []
        for lap in range(int(start // self._lap), int(stop // self._lap) + 1):
            t = self._frames.t - self._frames.t[0] + lap * self._lap
            first, last = np.searchsorted(t, [start, stop])
            part = self._frames[int(first) : int(last)]
            parts.append(replace(part, t=part.t + lap * self._lap))
        return Frames.concatenate(parts)


class Witness:
    """Progress of a child in shared memory: seconds driven, being saved, and saved."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, 24)

    def __getitem__(self, i: int) -> float:
        value: float = struct.unpack_from("d", self._memory, 8 * i)[0]
        return value

    def __setitem__(self, i: int, value: float) -> None:
        struct.pack_into("d", self._memory, 8 * i, value)


DRIVEN, SAVING, SAVED = range(3)


def live(drive: Drive, directory: Path, config: Config, witness: Witness, start: float) -> None:
    """Main function of a child."""
    store, pipeline = StateStore(directory), Pipeline(config)
    state, _ = store.load(KEY)
    if state is not None:
        pipeline.restore(state["pipeline"])
    t, due = start, start + INTERVAL
    while True:
        witness[DRIVEN] = t + PIECE
        for _ in pipeline.feed(drive.between(t, t + PIECE)):
            pass
        t += PIECE
        if t >= due:
            due = t + INTERVAL
            witness[SAVING] = t
            store.save({"at": t, "pipeline": pipeline.state()}, KEY)
            witness[SAVED] = t


def cut(drive: Drive, directory: Path, config: Config, kills: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill ``kills`` children, one after the other, and count the states found."""
    witness, counts, losses = Witness(), dict.fromkeys(COUNTS, 0), [0.0]
    begin, frames, mass = 0.0, 0, float("nan")
    for _ in range(kills):
        child = os.fork()
        if child == 0:
            try:
                live(drive, directory, config, witness, begin)
            finally:
                os._exit(70)  # reached only after an error: a child runs until it is killed
        time.sleep(rng.uniform(0, MAX_LIFE))
        os.kill(child, signal.SIGKILL)
        counts["failed"] += os.WIFEXITED(os.waitpid(child, 0)[1])
        counts["while_saving"] += witness[SAVING] > witness[SAVED]
        counts["leftovers"] += any(directory.glob("*.part"))
        state, reason = StateStore(directory).load(KEY)
        counts["previous_used"] += "previous state is used" in reason
        if state is None:
            counts["lost"] += witness[SAVED] > 0
        else:
            pipeline = Pipeline(config)
            try:
                pipeline.restore(state["pipeline"])
            except StateError:
                counts["corrupt"] += 1
            if state["at"] not in (witness[SAVED], witness[SAVING]) or pipeline.traffic.frames < frames:
                counts["corrupt"] += 1
            # Driving of this child before its first save and after its last.
            losses.append(witness[DRIVEN] - max(state["at"], begin))
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
    drive = Drive(arguments.minutes, arguments.seed)
    with tempfile.TemporaryDirectory() as directory:
        rng = np.random.default_rng(arguments.seed)
        found = cut(drive, Path(directory), Config(), arguments.kills, rng)
    if arguments.json:
        print(json.dumps(found))
    else:
        print("\n".join(f"{name.replace('_', ' '):16} {value:.6g}" for name, value in found.items()))
    bad = found["lost"] + found["corrupt"] + found["failed"]
    return int(bad > 0 or found["longest_loss_s"] > INTERVAL + PIECE)


if __name__ == "__main__":
    sys.exit(main())
