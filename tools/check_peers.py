"""roadload beside online estimators of the literature, on the same simulated drives, rows, masks and lag.

    python tools/check_peers.py [--drives 20] [--training 6] [--minutes 60] [--seed 1000]
    python tools/check_peers.py --hills [--drives 54] [--training 18] [--minutes 40] [--seed 1]

On level roads, mass, A and C of the recursion and of the filter in `peers/level.py`. With ``--hills`` the mass by those
in `peers/hills.py`, on the drives of `check_accuracy.py --hills` whose road is hidden; they are told the true A and C
where they need them. All get the aligned rows at 10 Hz, the masks of roadload's admission and the lag between power
and speed that roadload finds. Their settings have the smallest mean relative error on training drives, which are not
part of the comparison.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import KINDS, RARELY, drive, hills, numbered, read, traffic
from harness.scores import Score, rms, summary
from peers.hills import Band, Known, SlopeNoise, TwoFactors, band_passed, kalman_with_slope, two_forgetting_factors
from peers.level import Forgetting, Normal, ProcessNoise, Stretch, extended_kalman, recursive_least_squares, stretches

from estimator.config import Config, from_dict
from estimator.simulation.recording import Recording
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck

TRAINING_SEED = 5000
FACTORS = (0.9997, 0.9999, 0.99999, 1.0)  # per row: memories of 6 min, 17 min, 3 h and without end
FORGETTING = [Forgetting(*x) for x in product(FACTORS, FACTORS, (0.05, 0.1, 0.2, 0.4, 0.8))]
PROCESS_NOISE = [ProcessNoise(*x) for x in product((3e3, 10e3, 30e3, 100e3), (0.0, 0.01, 0.1, 0.3), (0.01, 0.03))]
TWO_FACTORS = [TwoFactors(*x) for x in product((0.9999, 1.0), (0.97, 0.99, 0.997), (0.2, 0.8))]
SLOPE_NOISE = [SlopeNoise(*x) for x in product((1e4, 5e4), (0.005, 0.02), (0.01, 0.03))]
BANDS = [Band(*x) for x in product((0.02, 0.05, 0.1, 0.2), (0.4, 0.8, 1.6))]
LIMITS = (0.02, 0.05)  # errors of the mass below which drives are counted
Peers = Mapping[str, tuple[Any, Sequence[Any]]]  # by name: the peer, and settings to try
LEVEL: Peers = {"RLS": (recursive_least_squares, FORGETTING), "EKF": (extended_kalman, PROCESS_NOISE)}
HILLS: Peers = {
    "RLS, two forgetting factors": (two_forgetting_factors, TWO_FACTORS),
    "EKF with the slope": (kalman_with_slope, SLOPE_NOISE),
    "band-passed force on acceleration": (band_passed, BANDS),
}


@dataclass(frozen=True)
class Drive:
    """One simulated drive: kind of road, true parameters, rows for the peers, and the scores of roadload."""

    kind: str
    truth: dict[str, float]
    data: list[Stretch]
    own: dict[str, Score]

    @classmethod
    def of(cls, recording: Recording, kind: str, names: Sequence[str], config: Config) -> "Drive":
        """Send as CAN frames, decode, align and estimate; the parameters that are compared are ``names``."""
        (rows, final, lag), truck = read(traffic(recording), config), recording.truth.truck
        truth = {name: float(getattr(truck, name)) for name in ("A", "C", "mass")}
        marginals = {name: getattr(final, name) for name in names}
        own = {name: Score.of(x, truth[name]) for name, x in marginals.items() if x is not None}
        return cls(kind, truth, stretches(rows, config.admission, lag), own)

    @property
    def known(self) -> Known:
        """What the peers over hills are told."""
        return Known(self.truth["A"], self.truth["C"])


def level_drive(seed: int, options: argparse.Namespace) -> Drive:
    """The drive of one truck on level roads."""
    rng = np.random.default_rng(seed)
    recording = drive(draw_truck(rng), "mixed", options.minutes, rng, sensors=Sensors(speed_noise=0.01))
    return Drive.of(recording, "mixed", ("A", "C", "mass"), Config())


def hidden_drive(seed: int, number: int, options: argparse.Namespace) -> Drive:
    """Drive ``number`` of the set ``seed`` over hills."""
    rng = np.random.default_rng([seed, number])
    world = hills(number, rng)
    return Drive.of(world.drive(options.minutes, rng), world.kind, ("mass",), from_dict(RARELY))


MASSES = tuple(f"{name}, mass" for name in ("roadload", *LEVEL, *HILLS))
Answer = Callable[[Drive, Any], Mapping[str, Normal]]  # of a peer, with settings


def tuned(name: str, answer: Answer, grid: Sequence[Any], training: Sequence[Drive]) -> Any:
    """The settings of ``grid`` with the smallest mean relative error over the ``training`` drives."""

    def error(settings: Any) -> float:
        answers = [(drive, answer(drive, settings)) for drive in training]
        return float(
            np.mean([abs(x.mean / drive.truth[key] - 1) for drive, found in answers for key, x in found.items()])
        )

    return min(progress(grid, f"tuning {name}"), key=error)


def measure(options: argparse.Namespace) -> Figures:
    """Tune the peers, and compare all on further drives."""
    peers = HILLS if options.hills else LEVEL

    def drives(seed: int, count: int, doing: str) -> list[Drive]:
        if options.hills:
            return [hidden_drive(seed, number, options) for number in progress(numbered(count, "hidden"), doing)]
        return [level_drive(seed + number, options) for number in progress(range(count), doing)]

    def answer_of(peer: Any) -> Answer:
        if options.hills:
            return lambda drive, settings: {"mass": peer(drive.data, settings, drive.known)}
        return lambda drive, settings: peer(drive.data, settings)

    training = drives(TRAINING_SEED, options.training, "driving for training")
    settings = {name: tuned(name, answer_of(peer), grid, training) for name, (peer, grid) in peers.items()}
    compared = drives(options.seed, options.drives, "driving")
    scores = {"roadload": [drive.own for drive in compared]}
    for name, (peer, _) in peers.items():
        found = [(drive, answer_of(peer)(drive, settings[name])) for drive in compared]
        scores[name] = [{key: x.score(drive.truth[key]) for key, x in answer.items()} for drive, answer in found]
    return {
        "settings": {name: asdict(chosen) for name, chosen in settings.items()},
        "estimators": {name: _figures(compared, each) for name, each in scores.items()},
    }


def _figures(drives: Sequence[Drive], scores: Sequence[Mapping[str, Score]]) -> Figures:
    """Figures of an estimator by parameter, and the errors of its mass by kind of road."""
    kinds = {
        kind: [x["mass"].error for d, x in zip(drives, scores, strict=True) if "mass" in x and d.kind == kind]
        for kind in KINDS
    }
    names = [name for name in ("A", "C", "mass") if any(name in each for each in scores)]
    return {
        **{name: summary([each[name] for each in scores if name in each], LIMITS) for name in names},
        "rms_by_kind": {kind: rms(errors) for kind, errors in kinds.items() if errors},
    }


def tables(figures: Figures) -> list[Table]:
    """A row for each estimator and parameter, and the settings of the peers."""
    limits = [f"within_{100 * limit:g}_percent" for limit in LIMITS]
    rows = []
    for name, found in figures["estimators"].items():
        for key in ("A", "C", "mass"):
            if x := found.get(key):
                errors = [percent(x["median"], 2), percent(x["worst"], 2), percent(x["bias"], 2, "+")]
                kinds = [percent(found["rms_by_kind"].get(kind) if key == "mass" else None) for kind in KINDS]
                counts = [str(x["estimated"]), *(str(x[limit]) for limit in limits)]
                rows.append([f"{name}, {key}", *counts, *errors, *kinds, f"{x['holds']} of {x['estimated']}"])
    words = [limit.replace("_percent", " %").replace("_", " ") for limit in limits]
    kinds = [f"rms, {kind}" for kind in KINDS]
    columns = ("", "estimated", *words, "median error", "worst", "bias", *kinds, "90 % intervals that hold")
    chosen = [
        [name, ", ".join(f"{key} {x:g}" for key, x in found.items())] for name, found in figures["settings"].items()
    ]
    return [Table("", columns, rows), Table("Settings by training drives", ("", "settings"), chosen)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the drives and the world of the level ones."""
    drive_options(drives=20, minutes=60.0, seed=1000)(parser)
    parser.add_argument("--training", type=int, default=6, metavar="DRIVES")
    parser.add_argument("--hills", action="store_true", help="roads with slopes that no signal shows")


CHECK = Check(
    title="Online estimators of the literature",
    measure=measure,
    tables=tables,
    headline=Cells(rows=MASSES, columns=("median error", "90 % intervals that hold")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
