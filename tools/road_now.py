"""The road under the vehicle as it is broadcast, against the truth and beside recursive least squares.

    python tools/road_now.py [--drives 12] [--training 3] [--minutes 40] [--seed 1] [--json]

The drives are those of `accuracy.py --hills`, played to the daemon's loop. "At the stride" is the slope at the newest
stride, given the strides up to it; "as broadcast" the slope where the vehicle is when the message is sent, once a
second. The peer is the recursion with two forgetting factors of `peers_hills.py`, on roadload's rows, masks and lag. It
does not see an altimeter. A slope and rolling resistance are one to it: it is told the true A and C of the truck, or
else those of a usual one. Its settings have the smallest error of the slope on training drives, with A and C told.
Both are compared at the strides whose force is known, and the peer has the rows up to the end of each. All errors are
from the first broadcast on, in per cent of slope.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np
from accuracy import ALTIMETERS, hills
from numpy.typing import NDArray
from peers_hills import Known, TwoFactors, slopes_by_two_factors
from peers_online import START, Z90, Stretch, stretches
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config
from estimator.estimates import Estimate, Slope
from estimator.samples import Rows
from estimator.signals import Floats
from estimator.streaming.listener import TICK, InlineWorker, Listener
from estimator.streaming.row_stream import Block, RowStream
from estimator.strides import DURATION

TRAINING_SEED = 5000
TWO_FACTORS = [TwoFactors(*x) for x in product((0.9999, 1.0), (0.8, 0.9, 0.95, 0.98), (0.4, 0.8, 1.6))]
USUAL = Known(*START[:2].tolist())
NEAR = 0.3  # s between the end of a stride and the peer's newest row, where its force is known
PERCENT = 100.0


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One drive: what was found ``at_strides`` and ``broadcast``, and what the peer gets.

    Both are (n, 4): time [s], error, standard deviation and true slope [%]. ``now`` (m, 3): times of the broadcasts and
    of the newest rows then [s], true slope [%]. ``heights`` (k, 2): error and standard deviation [m].
    """

    altimeter: str
    at_strides: Floats
    broadcast: Floats
    now: Floats
    heights: Floats
    data: list[Stretch]
    known: Known
    truth: Floats  # (r, 2) time [s] and slope [%]

    @classmethod
    def simulate(cls, number: int, seed: int, minutes: float) -> "Drive":
        """Drive, send as CAN frames, and listen."""
        rng = np.random.default_rng([seed, number])
        world = hills(number, rng)
        recording = world.recorded(minutes, rng)
        truth, frames = recording.truth, frames_of(recording.signals)
        begin = float(frames.t[0])
        slope = PERCENT * truth.grade / np.hypot(1.0, truth.grade)
        strides, seconds, heights = dict[float, list[float]](), list[list[float]](), list[list[float]]()
        worker = InlineWorker(Config())

        def true(t: float) -> float:
            return float(np.interp(t - begin, truth.t, slope))

        def broadcast(t: float, estimate: Estimate | None, found: Slope | None) -> None:
            ahead = worker.road_now
            if found is None or ahead is None or (seconds and t - seconds[-1][0] < 1 - TICK / 2):
                return
            belief = ahead.belief
            at_stride = PERCENT * np.array([belief.mean[0], np.sqrt(belief.covariance[0, 0])])
            strides[belief.t] = [belief.t, at_stride[0] - true(belief.t), at_stride[1], true(belief.t)]
            seconds.append([t, PERCENT * found.sine - true(t), PERCENT * found.sd, true(t), ahead.t])
            rise = float(np.interp(t - begin, truth.t, truth.altitude)) - truth.altitude[0]
            heights.append([found.height - rise, found.height_sd])

        listener = Listener(worker, broadcast)
        edges = np.searchsorted(frames.t, np.arange(begin, frames.t[-1] + TICK, TICK)).tolist()
        for first, last in pairwise(edges):
            listener.hear(frames[first:last])
            listener.turn(float(frames.t[last - 1]))
        worker.close()
        rows = [x for item in RowStream(Config()).feed(frames) if isinstance(item, Block) for x in item.rows]
        evidence, sent = worker.pipeline.estimator.evidence, np.array(seconds).reshape(-1, 5)
        shown = next(name for name, noise in ALTIMETERS.items() if noise == world.altimeter)
        return cls(
            altimeter=shown,
            at_strides=np.array(list(strides.values())).reshape(-1, 4),
            broadcast=sent[:, :4],
            now=sent[:, [0, 4, 3]],
            heights=np.array(heights).reshape(-1, 2),
            data=stretches(Rows.concatenate(*rows), Config().admission, 0.0 if evidence is None else evidence.lag),
            known=Known(truth.truck.A, truth.truck.C),
            truth=np.column_stack([truth.t + begin, slope]),
        )

    def beside(self, settings: TwoFactors, known: Known) -> tuple[Floats, Floats]:
        """Errors [%] where the force is known, own and the peer's (n, 2), and the peer's held until broadcasts (m,)."""
        t, found = slopes_by_two_factors(self.data, settings, known).T
        ends = self.at_strides[:, 0] + DURATION / 2

        def newest(until: Floats) -> NDArray[np.intp]:
            return np.clip(np.searchsorted(t, until, side="right") - 1, 0, None)

        at_ends = newest(ends)
        near = np.abs(t[at_ends] - ends) < NEAR
        theirs = PERCENT * found[at_ends] - self.at_strides[:, 3]
        held = PERCENT * found[newest(self.now[:, 1])] - self.now[:, 2]
        return np.column_stack([self.at_strides[:, 1], theirs])[near], held


def rms(errors: Sequence[Floats]) -> float:
    """Of the errors of all drives."""
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def figures_of(drives: Sequence[Drive], settings: TwoFactors) -> dict[str, Any]:
    """Errors and coverage of some drives."""
    figures: dict[str, Any] = {"drives": len(drives), "hours": sum(len(x.broadcast) for x in drives) / 3600}
    for name, parts in (("stride", [x.at_strides for x in drives]), ("broadcast", [x.broadcast for x in drives])):
        within = [float(np.mean(np.abs(part[:, 1]) <= Z90 * part[:, 2])) for part in parts]
        every = np.concatenate(parts)
        figures[name] = {
            "rms": rms([part[:, 1] for part in parts]),
            "sd": float(np.sqrt(np.mean(every[:, 2] ** 2))),
            "holds": float(np.mean(np.abs(every[:, 1]) <= Z90 * every[:, 2])),
            "holds_least": min(within),
            "slopes": float(every[:, 3].std()),
        }
    told = [x.beside(settings, x.known) for x in drives]
    usual = [x.beside(settings, USUAL) for x in drives]
    figures["beside"] = {
        "roadload": rms([x[0][:, 0] for x in told]),
        "peer_told": rms([x[0][:, 1] for x in told]),
        "peer_usual": rms([x[0][:, 1] for x in usual]),
        "roadload_about_mean": rms([x[0][:, 0] - x[0][:, 0].mean() for x in told]),
        "peer_about_mean": rms([x[0][:, 1] - x[0][:, 1].mean() for x in told]),
        "peer_told_broadcast": rms([x[1] for x in told]),
        "peer_usual_broadcast": rms([x[1] for x in usual]),
    }
    heights = np.concatenate([x.heights for x in drives])
    if np.isfinite(heights).all():
        holds = float(np.mean(np.abs(heights[:, 0]) <= Z90 * heights[:, 1]))
        figures["height"] = {"rms": rms([x.heights[:, 0] for x in drives]), "holds": holds}
    return figures


def main() -> int:
    """Print errors and coverage by what shows the road."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=12, help="of each kind of altimeter")
    parser.add_argument("--training", type=int, default=3, metavar="DRIVES", help="with a hidden road")
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)

    def simulated(seed: int, numbers: Sequence[int], doing: str) -> list[Drive]:
        shown = track(numbers, doing, console=console, transient=True)
        drives = [Drive.simulate(number, seed, options.minutes) for number in shown]
        return [drive for drive in drives if len(drive.broadcast)]

    def numbered(altimeter: int, drives: int) -> list[int]:
        return [9 * (i // 3) + 3 * altimeter + i % 3 for i in range(drives)]

    training = simulated(TRAINING_SEED, numbered(0, options.training), "driving for training")
    settings = min(TWO_FACTORS, key=lambda x: rms([drive.beside(x, drive.known)[0][:, 1] for drive in training]))
    answers = {}
    for i, name in enumerate(ALTIMETERS):
        if drives := simulated(options.seed, numbered(i, options.drives), f"driving, {name}"):
            answers[name] = figures_of(drives, settings)
    if options.json:
        print(json.dumps({"settings": vars(settings), **answers}, indent=2))
        return 0
    print(f"peer: {settings}, from {len(training)} training drives")
    table = Table("road", "drives, h", "slopes, sd", "", "rms", "expected sd", "within 90 %", "least of a drive")
    for name, x in answers.items():
        for key, what in (("stride", "at the stride"), ("broadcast", "as broadcast")):
            found = x[key]
            errors = [f"{found['rms']:.2f} %", f"{found['sd']:.2f} %"]
            holds = [f"{PERCENT * found['holds']:.0f} %", f"{PERCENT * found['holds_least']:.0f} %"]
            table.add_row(name, f"{x['drives']}, {x['hours']:.1f}", f"{found['slopes']:.2f} %", what, *errors, *holds)
        if "height" in x:
            found = x["height"]
            table.add_row(name, "", "", "height", f"{found['rms']:.1f} m", "", f"{PERCENT * found['holds']:.0f} %", "")
    beside = Table("rms, force known", *(key.replace("_", " ") for key in next(iter(answers.values()))["beside"]))
    for name, x in answers.items():
        beside.add_row(name, *(f"{value:.2f} %" for value in x["beside"].values()))
    output = Console(width=None if sys.stdout.isatty() else 200)
    output.print(table)
    output.print(beside)
    return 0


if __name__ == "__main__":
    sys.exit(main())
