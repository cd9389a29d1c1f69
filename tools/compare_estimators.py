"""roadload beside two online estimators of the literature, on the same simulated drives and rows.

    python tools/compare_estimators.py [--drives 20] [--training 6] [--minutes 60] [--route mixed] [--json]

Trucks, roads and sensors are those of accuracy.py. Every estimator gets the aligned rows at 10 Hz, the masks of
roadload's admission and the lag between power and speed that roadload finds. Forgetting, cut-off and process noise of
the peers have the smallest mean relative error on training drives, which are not part of the comparison.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
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

from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config
from estimator.samples import Rows
from estimator.signals import Floats, Mask
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block

NAMES = ("A", "C", "mass")
METRES_PER_MINUTE = 2000.0  # of road, more than any truck drives
TRAINING_SEED = 5000
FACTORS = (0.9997, 0.9999, 0.99999, 1.0)  # per row: memories of 6 min, 17 min, 3 h and without end
FORGETTING = [Forgetting(*x) for x in product(FACTORS, FACTORS, (0.05, 0.1, 0.2, 0.4, 0.8))]
PROCESS_NOISE = [ProcessNoise(*x) for x in product((3e3, 10e3, 30e3, 100e3), (0.0, 0.01, 0.1, 0.3), (0.01, 0.03))]
Settings = TypeVar("Settings")


@dataclass(frozen=True)
class Drive:
    """One simulated drive: the ``truth`` [A, C, m], the rows for the peers, and roadload's result."""

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
        items = [*pipeline.traffic.feed(frames_of(recording.signals)), *pipeline.traffic.finish()]
        rows = Rows.concatenate(*(rows for item in items if isinstance(item, Block) for rows in item.rows))
        updates = [update for item in items for update in pipeline.take(item)]
        final = [*updates, *pipeline.finish()][-1]
        lag = 0.0 if pipeline.estimator.evidence is None else pipeline.estimator.evidence.lag
        truth = np.array([getattr(truck, name) for name in NAMES])
        marginals = [x for x in (getattr(final, name) for name in NAMES) if x is not None]
        return cls(
            truth,
            stretches(rows, config.admission, lag),
            np.array([x.mean for x in marginals]) if len(marginals) == len(NAMES) else None,
            np.array([x.q05 <= value <= x.q95 for x, value in zip(marginals, truth, strict=False)]),
        )


def tune(
    peer: Callable[[Sequence[Stretch], Settings], Estimate], grid: Sequence[Settings], training: Sequence[Drive]
) -> Settings:
    """The settings of ``grid`` with the smallest mean relative error of A, C, m over the ``training`` drives."""

    def error(settings: Settings) -> float:
        return float(np.mean([np.abs(peer(x.data, settings).theta / x.truth - 1) for x in training]))

    return min(track(grid, f"tuning {peer.__name__}", console=Console(stderr=True), transient=True), key=error)


def errors_of(
    peer: Callable[[Sequence[Stretch], Settings], Estimate], settings: Settings, drives: Sequence[Drive]
) -> list[tuple[Floats, Mask]]:
    """Relative errors (3,) of a peer on each drive, and which of its 90 % intervals (3,) hold the truth."""
    found = [(peer(drive.data, settings), drive.truth) for drive in drives]
    return [(estimate.theta / truth - 1, estimate.holds(truth)) for estimate, truth in found]


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
    answers: dict[str, list[tuple[Floats, Mask]]] = {
        "roadload": [(drive.means / drive.truth - 1, drive.held) for drive in drives if drive.means is not None],
        "RLS": errors_of(recursive_least_squares, forgetting, drives),
        "EKF": errors_of(extended_kalman, noise, drives),
    }
    figures: dict[str, Any] = {"settings": {"RLS": asdict(forgetting), "EKF": asdict(noise)}}
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
