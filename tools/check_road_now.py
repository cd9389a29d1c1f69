"""The road under the vehicle as it is broadcast, against the truth and beside recursive least squares.

    python tools/check_road_now.py [--drives 12] [--training 3] [--minutes 40] [--seed 1]

The drives are those of `check_accuracy.py --hills`, played to the daemon's loop. "At the stride" is the slope at the
newest stride, given the strides up to it. "As broadcast" is the slope where the vehicle is when the message is sent,
once a second. The peer is the recursion with two forgetting factors of `peers/hills.py`, on roadload's rows, masks and
lag. It does not see an altimeter. A slope and rolling resistance are one to it: it is told the true A and C of the
truck, or else those of a usual one. Its settings have the smallest error of the slope on training drives, with A and C
told. Both are compared at the strides whose force is known, and the peer has the rows up to the end of each. All errors
are from the first broadcast on, in per cent of slope.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise, product

import numpy as np
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import ALTIMETERS, hills, numbered, traffic
from harness.scores import rms
from peers.hills import Known, TwoFactors, slopes_by_two_factors
from peers.level import START, Z90, Stretch, stretches

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

    Both are (n, 4): time [s], error, standard deviation and true slope [%]. ``heights`` (k, 2): error and standard
    deviation [m].
    """

    at_strides: Floats
    broadcast: Floats
    heights: Floats
    data: list[Stretch]
    known: Known

    @classmethod
    def simulate(cls, number: int, seed: int, minutes: float) -> "Drive":
        """Drive, send as CAN frames, and listen."""
        rng = np.random.default_rng([seed, number])
        world = hills(number, rng)
        recording = world.drive(minutes, rng)
        truth, frames = recording.truth, traffic(recording)
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
            seconds.append([t, PERCENT * found.sine - true(t), PERCENT * found.sd, true(t)])
            rise = float(np.interp(t - begin, truth.t, truth.altitude)) - truth.altitude[0]
            heights.append([found.height - rise, found.height_sd])

        listener = Listener(worker, broadcast)
        edges = np.searchsorted(frames.t, np.arange(begin, frames.t[-1] + TICK, TICK)).tolist()
        for first, last in pairwise(edges):
            listener.hear(frames[first:last])
            listener.turn(float(frames.t[last - 1]))
        worker.close()
        rows = [x for item in RowStream(Config()).feed(frames) if isinstance(item, Block) for x in item.rows]
        evidence = worker.pipeline.estimator.evidence
        return cls(
            at_strides=np.array(list(strides.values())).reshape(-1, 4),
            broadcast=np.array(seconds).reshape(-1, 4),
            heights=np.array(heights).reshape(-1, 2),
            data=stretches(Rows.concatenate(*rows), Config().admission, 0.0 if evidence is None else evidence.lag),
            known=Known(truth.truck.A, truth.truck.C),
        )

    def beside(self, settings: TwoFactors, known: Known) -> Floats:
        """Errors [%] where the force is known, own and the peer's (n, 2)."""
        t, found = slopes_by_two_factors(self.data, settings, known).T
        ends = self.at_strides[:, 0] + DURATION / 2
        at_ends = np.clip(np.searchsorted(t, ends, side="right") - 1, 0, None)
        near = np.abs(t[at_ends] - ends) < NEAR
        theirs = PERCENT * found[at_ends] - self.at_strides[:, 3]
        errors: Floats = np.column_stack([self.at_strides[:, 1], theirs])[near]
        return errors


def figures_of(drives: Sequence[Drive], settings: TwoFactors) -> Figures:
    """Errors and coverage of some drives."""
    figures: Figures = {"drives": len(drives), "hours": sum(len(x.broadcast) for x in drives) / 3600}
    for name, parts in (("stride", [x.at_strides for x in drives]), ("broadcast", [x.broadcast for x in drives])):
        within = [float(np.mean(np.abs(part[:, 1]) <= Z90 * part[:, 2])) for part in parts]
        every = np.concatenate(parts)
        figures[name] = {
            "rms": rms(np.concatenate([part[:, 1] for part in parts])),
            "sd": float(np.sqrt(np.mean(every[:, 2] ** 2))),
            "holds": float(np.mean(np.abs(every[:, 1]) <= Z90 * every[:, 2])),
            "holds_least": min(within),
            "slopes": float(every[:, 3].std()),
        }
    told = [x.beside(settings, x.known) for x in drives]
    usual = [x.beside(settings, USUAL) for x in drives]
    figures["beside"] = {
        "roadload": rms(np.concatenate([x[:, 0] for x in told])),
        "peer_told": rms(np.concatenate([x[:, 1] for x in told])),
        "peer_usual": rms(np.concatenate([x[:, 1] for x in usual])),
        "roadload_about_mean": rms(np.concatenate([x[:, 0] - x[:, 0].mean() for x in told])),
        "peer_about_mean": rms(np.concatenate([x[:, 1] - x[:, 1].mean() for x in told])),
    }
    heights = np.concatenate([x.heights for x in drives])
    if np.isfinite(heights).all():
        holds = float(np.mean(np.abs(heights[:, 0]) <= Z90 * heights[:, 1]))
        figures["height"] = {"rms": rms(np.concatenate([x.heights[:, 0] for x in drives])), "holds": holds}
    return figures


def measure(options: argparse.Namespace) -> Figures:
    """Tune the peer on training drives; errors and coverage by what shows the road."""

    def simulated(seed: int, numbers: Sequence[int], doing: str) -> list[Drive]:
        drives = [Drive.simulate(number, seed, options.minutes) for number in progress(numbers, doing)]
        return [drive for drive in drives if len(drive.broadcast)]

    training = simulated(TRAINING_SEED, numbered(options.training, "hidden"), "driving for training")
    settings = min(
        TWO_FACTORS, key=lambda x: rms(np.concatenate([drive.beside(x, drive.known)[:, 1] for drive in training]))
    )
    drives = {name: simulated(options.seed, numbered(options.drives, name), f"driving, {name}") for name in ALTIMETERS}
    roads = {name: figures_of(driven, settings) for name, driven in drives.items() if driven}
    return {"settings": asdict(settings), "roads": roads}


def tables(figures: Figures) -> list[Table]:
    """Errors and coverage by what shows the road, and those beside the peer."""
    rows = []
    for name, x in figures["roads"].items():
        for key, what in (("stride", "at the stride"), ("broadcast", "as broadcast")):
            found = x[key]
            errors = [f"{found['rms']:.2f} %", f"{found['sd']:.2f} %"]
            holds = [percent(found["holds"], 0), percent(found["holds_least"], 0)]
            driven = [str(x["drives"]), f"{x['hours']:.1f}", f"{found['slopes']:.2f} %"]
            rows.append([f"{name}, {what}", *driven, *errors, *holds])
        if "height" in x:
            error, holds = f"{x['height']['rms']:.1f} m", [percent(x["height"]["holds"], 0), ""]
            rows.append([f"{name}, height", *driven[:2], "", error, "", *holds])
    columns = ("road", "drives", "h", "slopes, sd", "rms", "expected sd", "within 90 %", "least of a drive")
    beside = {name: x["beside"] for name, x in figures["roads"].items()}
    names = list(next(iter(beside.values()), ()))
    compared = [[name, *(f"{value:.2f} %" for value in x.values())] for name, x in beside.items()]
    told = ", ".join(f"{key} {value:g}" for key, value in figures["settings"].items())
    title = f"rms of the slope where the force is known; the peer with {told}"
    return [Table("", columns, rows), Table(title, ("", *(name.replace("_", " ") for name in names)), compared)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the drives."""
    drive_options(drives=12, minutes=40.0)(parser)
    parser.add_argument("--training", type=int, default=3, metavar="DRIVES", help="with a hidden road")


CHECK = Check(
    title="The slope under the vehicle",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("hidden, at", "poor, at", "good, at"), columns=("rms", "within 90 %")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
