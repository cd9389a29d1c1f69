"""roadload beside two online estimators of the literature, on the same simulated drives and rows.

    python tools/compare_estimators.py [--drives 20] [--training 6] [--minutes 60] [--route mixed] [--json]

Trucks, roads and sensors are those of accuracy.py. Every estimator gets the aligned rows at 10 Hz, the masks of
roadload's admission and the lag between power and speed that roadload finds. Forgetting, cut-off and process noise of
the peers are those with the smallest mean relative error on training drives, none of which is judged.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any, TypeVar

import numpy as np
from peers_online import (
    Estimate,
    Forgetting,
    ProcessNoise,
    Stretch,
    extended_kalman,
    recursive_least_squares,
    stretches,
)
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.recorder import frames_of
from estimator.config import Config
from estimator.estimation.estimator import Estimator
from estimator.estimation.lag import fit_lag
from estimator.pipeline import Pipeline
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Mask
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck

NAMES = ("A", "C", "mass")
METRES_PER_MINUTE = 2000.0  # of road, more than any truck drives
TRAINING_SEED = 5000
FACTORS = (0.9997, 0.9999, 0.99999, 1.0)  # per row: memories of 6 min, 17 min, 3 h and for ever
FORGETTING = [Forgetting(*x) for x in product(FACTORS, FACTORS, (0.05, 0.1, 0.2, 0.4, 0.8))]
PROCESS_NOISE = [ProcessNoise(*x) for x in product((3e3, 10e3, 30e3, 100e3), (0.0, 0.01, 0.1, 0.3), (0.01, 0.03))]
Settings = TypeVar("Settings")


class RowKeeper(Estimator):
    """The project's estimator, which keeps the rows that it was fed for the others."""

    def __init__(self, config: Config) -> None:
        super().__init__(config, np.random.default_rng(config.sampler.seed))
        self.rows: list[Rows] = []

    def feed(self, rows: Rows) -> Iterator[Any]:
        """See `Estimator.feed`."""
        self.rows.append(rows)
        yield from super().feed(rows)


@dataclass(frozen=True)
class Drive:
    """One simulated drive: the ``truth`` [A, C, m], what the peers may see, and what roadload made of it."""

    truth: Floats
    data: list[Stretch]
    means: Floats | None  # (3,); None if roadload gave no estimate
    held: Mask  # truth inside roadload's 90 % intervals (3,)

    @classmethod
    def simulate(cls, seed: int, options: argparse.Namespace) -> "Drive":
        """Drive, send as CAN frames, decode, align and estimate."""
        rng = np.random.default_rng(seed)
        truck = draw_truck(rng)
        route = generate_route(options.route, options.minutes * METRES_PER_MINUTE, rng)
        sensors = Sensors(speed_noise=options.speed_noise)
        recording = record(truck, route, options.minutes * 60, rng, sensors=sensors)
        config = Config()
        pipeline = Pipeline(config)
        pipeline.estimator = keeper = RowKeeper(config)
        final = [*pipeline.feed(frames_of(recording.signals)), *pipeline.finish()][-1]
        rows = keeper.rows[0]
        for more in keeper.rows[1:]:
            rows = Rows.concatenate(rows, more)
        lag = fit_lag(rows.speed, rows.power, STEP, config.kinematics.maximum_lag_s)
        truth = np.array([getattr(truck, name) for name in NAMES])
        marginals = [x for x in (getattr(final, name) for name in NAMES) if x is not None]
        return cls(
            truth,
            stretches(rows, config.admission, lag),
            np.array([x.mean for x in marginals]) if marginals else None,
            np.array([x.q05 <= value <= x.q95 for x, value in zip(marginals, truth, strict=bool(marginals))]),
        )


def tune(
    peer: Callable[[Sequence[Stretch], Settings], Estimate], grid: Sequence[Settings], training: Sequence[Drive]
) -> Settings:
    """The settings of ``grid`` with the smallest mean relative error of A, C, m over the ``training`` drives."""

    def error(settings: Settings) -> float:
        return float(np.mean([np.abs(peer(x.data, settings).theta / x.truth - 1) for x in training]))

    return min(track(grid, f"tuning {peer.__name__}", console=Console(stderr=True), transient=True), key=error)


def main() -> int:
    """Print error and coverage of all three, and the settings that tuning chose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--training", type=int, default=6, metavar="DRIVES")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--route", choices=["urban", "mixed", "highway"], default="mixed")
    parser.add_argument("--speed-noise", type=float, default=0.01, metavar="m/s")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)

    def simulate(first: int, count: int, doing: str) -> list[Drive]:
        seeds = track(range(first, first + count), doing, console=console, transient=True)
        return [Drive.simulate(seed, options) for seed in seeds]

    training = simulate(TRAINING_SEED, options.training, "driving for training")
    forgetting = tune(recursive_least_squares, FORGETTING, training)
    noise = tune(extended_kalman, PROCESS_NOISE, training)
    drives = simulate(options.seed, options.drives, "driving")
    estimated = [drive for drive in drives if drive.means is not None]
    answers = {"roadload": [(drive.means / drive.truth - 1, drive.held) for drive in estimated]}
    peers = {"RLS": (recursive_least_squares, forgetting), "EKF": (extended_kalman, noise)}
    for name, (peer, settings) in peers.items():
        found = [(peer(drive.data, settings), drive.truth) for drive in drives]
        answers[name] = [(x.theta / truth - 1, x.holds(truth)) for x, truth in found]

    figures: dict[str, Any] = {"settings": {name: asdict(settings) for name, (_, settings) in peers.items()}}
    table = Table("", "", "median error", "worst", "90 % intervals that hold the truth")
    for name, results in answers.items():
        size = np.abs([error for error, _ in results])
        held = np.sum([held for _, held in results], axis=0)
        figures[name] = {
            parameter: {"median": float(np.median(size[:, i])), "worst": float(size[:, i].max()), "holds": int(held[i])}
            for i, parameter in enumerate(NAMES)
        }
        for parameter, x in figures[name].items():
            shown = [f"{100 * x[key]:.2f} %" for key in ("median", "worst")]
            table.add_row(name, parameter, *shown, f"{x['holds']} of {len(results)}")
        table.add_section()
    if options.json:
        print(json.dumps(figures, indent=2))
    else:
        print(f"settings from {options.training} training drives: {forgetting}, {noise}")
        Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
