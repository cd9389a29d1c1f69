"""roadload beside three online estimators of the mass, on the same drives over hills that no signal shows.

    python tools/compare_over_hills.py [--drives 54] [--training 18] [--minutes 40] [--seed 1] [--json]

The drives are those of `accuracy.py --hills` whose road is hidden, with the same seed. Every estimator gets the
aligned rows at 10 Hz, the masks of roadload's admission and the lag between power and speed that roadload finds; the
others are told the true A and C where they need them. Their settings have the smallest mean relative error on training
drives, which are not part of the comparison.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import count, islice, product
from typing import Any, TypeVar

import numpy as np
from accuracy import ALTIMETERS, KINDS, RARELY, hills
from peers_hills import (
    Band,
    Known,
    Mass,
    SlopeNoise,
    TwoFactors,
    band_passed,
    kalman_with_slope,
    two_forgetting_factors,
)
from peers_online import Stretch, stretches
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.config import from_dict
from estimator.estimates import Marginal
from estimator.samples import Rows
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block

TRAINING_SEED = 5000
TWO_FACTORS = [TwoFactors(*x) for x in product((0.9999, 1.0), (0.97, 0.99, 0.997), (0.2, 0.8))]
SLOPE_NOISE = [SlopeNoise(*x) for x in product((1e4, 5e4), (0.005, 0.02), (0.01, 0.03))]
BANDS = [Band(*x) for x in product((0.02, 0.05, 0.1, 0.2), (0.4, 0.8, 1.6))]
LIMITS = (0.02, 0.05)  # errors of the mass below which drives are counted
Settings = TypeVar("Settings")
Peer = Callable[[Sequence[Stretch], Settings, Known], Mass]


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One simulated drive: ``kind`` of road, true ``mass`` [kg], what the others know and get, and roadload's mass."""

    kind: str
    mass: float
    known: Known
    data: list[Stretch]
    found: Marginal | None

    @classmethod
    def simulate(cls, number: int, seed: int, minutes: float) -> "Drive":
        """Drive, send as CAN frames, decode, align and estimate."""
        rng = np.random.default_rng([seed, number])
        world = hills(number, rng)
        truck, frames = world.drive(minutes, rng)
        config = from_dict(RARELY)
        pipeline = Pipeline(config)
        items = [*pipeline.traffic.feed(frames), *pipeline.traffic.finish()]
        rows = Rows.concatenate(*(rows for item in items if isinstance(item, Block) for rows in item.rows))
        updates = [update for item in items for update in pipeline.take(item)]
        final = [*updates, *pipeline.finish()][-1]
        evidence = pipeline.estimator.evidence
        return cls(
            kind=world.kind,
            mass=truck.mass,
            known=Known(truck.A, truck.C),
            data=stretches(rows, config.admission, 0.0 if evidence is None else evidence.lag),
            found=final.mass,
        )


def simulated(seed: int, drives: int, minutes: float, doing: str) -> list[Drive]:
    """The first ``drives`` over a hidden road of the set ``seed``."""
    hidden = (number for number in count() if number // 3 % 3 == list(ALTIMETERS).index("hidden"))
    numbers = track(list(islice(hidden, drives)), doing, console=Console(stderr=True), transient=True)
    return [Drive.simulate(number, seed, minutes) for number in numbers]


def tune(peer: Peer[Settings], grid: Sequence[Settings], training: Sequence[Drive]) -> Settings:
    """The settings of ``grid`` with the smallest mean relative error over the ``training`` drives."""

    def error(settings: Settings) -> float:
        return float(np.mean([abs(peer(x.data, settings, x.known).mean / x.mass - 1) for x in training]))

    return min(track(grid, f"tuning {peer.__name__}", console=Console(stderr=True), transient=True), key=error)


def figures_of(drives: Sequence[Drive], found: Sequence[tuple[float, bool] | None]) -> dict[str, Any]:
    """Figures of an estimator from each drive's relative error and whether its interval holds; None: no mass."""
    error = np.array([x[0] for x in found if x is not None])
    kinds = {
        kind: [x[0] for drive, x in zip(drives, found, strict=True) if x is not None and drive.kind == kind]
        for kind in KINDS
    }
    return {
        "mass": len(error),
        **{f"within_{100 * limit:g}_percent": int((np.abs(error) < limit).sum()) for limit in LIMITS},
        "median": float(np.median(np.abs(error))),
        "worst": float(np.abs(error).max()),
        "bias": float(error.mean()),
        "holds": sum(x[1] for x in found if x is not None),
        "rms": {kind: float(np.sqrt(np.mean(np.square(x)))) for kind, x in kinds.items() if x},
    }


def main() -> int:
    """Print error and coverage of all four, and the settings that tuning chose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=54)
    parser.add_argument("--training", type=int, default=18, metavar="DRIVES")
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    training = simulated(TRAINING_SEED, options.training, options.minutes, "driving for training")
    factors = tune(two_forgetting_factors, TWO_FACTORS, training)
    noise = tune(kalman_with_slope, SLOPE_NOISE, training)
    band = tune(band_passed, BANDS, training)
    drives = simulated(options.seed, options.drives, options.minutes, "driving")

    def judged(peer: Peer[Settings], settings: Settings) -> list[tuple[float, bool] | None]:
        masses = [(peer(drive.data, settings, drive.known), drive.mass) for drive in drives]
        return [(found.mean / mass - 1, found.holds(mass)) for found, mass in masses]

    own = [
        None if x.found is None else (x.found.mean / x.mass - 1, x.found.q05 <= x.mass <= x.found.q95) for x in drives
    ]
    answers = {
        "roadload": figures_of(drives, own),
        "RLS, two forgetting factors": figures_of(drives, judged(two_forgetting_factors, factors)),
        "EKF with the slope": figures_of(drives, judged(kalman_with_slope, noise)),
        "band-passed force on acceleration": figures_of(drives, judged(band_passed, band)),
    }
    settings = [asdict(factors), asdict(noise), asdict(band)]
    if options.json:
        print(json.dumps({"settings": settings, **answers}, indent=2))
        return 0
    print(f"settings from {options.training} training drives: {factors}, {noise}, {band}")
    limits = [f"within {100 * limit:g} %" for limit in LIMITS]
    table = Table("", "mass", *limits, "median", "worst", "bias", *(f"rms, {kind}" for kind in KINDS), "interval holds")
    for name, x in answers.items():
        counts = [str(x["mass"]), *(str(x[f"within_{100 * limit:g}_percent"]) for limit in LIMITS)]
        errors = [f"{100 * x[key]:.1f} %" for key in ("median", "worst")]
        rms = [f"{100 * x['rms'].get(kind, np.nan):.1f} %" for kind in KINDS]
        table.add_row(name, *counts, *errors, f"{100 * x['bias']:+.1f} %", *rms, f"{x['holds']} of {x['mass']}")
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
