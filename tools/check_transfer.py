"""Gap closed as predicted on one drive, and as measured on another drive of the same truck.

    python tools/check_transfer.py [--effect NAME NAME ...] [--minutes 60] [--seed 1]

For each effect one simulated truck makes two drives on different roads, the effect in both. The first is diagnosed:
this gives the prediction. The second is diagnosed without and with `--effect` for the effects named on the first: this
gives the measured share. Then both are diagnosed jointly.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from harness.check import Cells, Check, Figures, Table, progress
from harness.drives import diagnose, named, roadload

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.answers.simulation import SimulationAnswer
from estimator.model.effects import BY_NAME

# Effects that the model takes without further data and that show at their usual size on one drive.
EFFECTS = ("grade", "headwind", "warm_up", "load_loss", "torque_bias", "auxiliary_load", "cornering", "sensor_drift")


def simulate_pair(effect: str, minutes: float, seed: int, folder: Path) -> tuple[Path, Path]:
    """Write two logs of identical trucks."""
    first, second = folder / f"{effect}-1.blf", folder / f"{effect}-2.blf"
    common = ["--minutes", str(minutes), "--effect", effect]
    truth = roadload(SimulationAnswer, "simulate", first, *common, "--seed", str(seed)).truth
    same = ["--mass", str(truth.mass_kg), "--A", str(truth.A_N), "--C", str(truth.C_N_s2_m2)]
    roadload(SimulationAnswer, "simulate", second, *common, *same, "--seed", str(seed + 1))
    return first, second


def row(effect: str, first: Path, second: Path) -> dict[str, Any]:
    """Predicted share of the first drive and measured share of the second, for the effects named on the first."""
    promise = diagnose(first)
    able = [name for name in named(promise) if name in BY_NAME and BY_NAME[name].is_streaming]
    plain = diagnose(second)
    extended = diagnose(second, *(word for name in able for word in ("--effect", name))) if able else plain
    together = diagnose(first, second)
    closed = [effect.gap_closed for effect in promise.effects if effect.name in able and effect.gap_closed]
    promised = [
        100 * min(sum(getattr(each, bound) or 0.0 for each in closed), 1.0) for bound in ("fraction", "q05", "q95")
    ]
    reached = _reached(plain, extended) if able else None
    return {
        "effect": effect,
        "named on drive 1": ", ".join(named(promise)) or promise.verdict,
        "promised [%]": promised if closed else None,
        "reached on drive 2 [%]": None if reached is None else 100 * reached,
        "kW before": plain.rms_base_kW,
        "kW after": extended.rms_base_kW,
        "named beside it on drive 2": ", ".join(named(extended)) or extended.verdict,
        "named from both together": ", ".join(named(together)) or together.verdict,
    }


def _reached(plain: DiagnosisAnswer, extended: DiagnosisAnswer) -> float | None:
    """Closed share of the gap above the noise floor of the extended model."""
    if plain.rms_base_kW is None or extended.rms_base_kW is None or extended.noise_floor_kW is None:
        return None
    gap = plain.rms_base_kW**2 - extended.noise_floor_kW**2
    return None if gap <= 0 else 1 - (extended.rms_base_kW**2 - extended.noise_floor_kW**2) / gap


def measure(options: argparse.Namespace) -> Figures:
    """A row for each effect."""
    effects = options.effect
    with tempfile.TemporaryDirectory() as folder:
        pairs = (
            (effect, simulate_pair(effect, options.minutes, options.seed + 2 * effects.index(effect), Path(folder)))
            for effect in progress(effects, "driving")
        )
        return {"effects": [row(effect, *pair) for effect, pair in pairs]}


def tables(figures: Figures) -> list[Table]:
    """A row for each effect."""
    return [Table.of("a second drive of the same truck", figures["effects"])]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the effects and the drives."""
    parser.add_argument("--effect", nargs="+", default=list(EFFECTS), metavar="NAME", help="default: %(default)s")
    parser.add_argument("--minutes", type=float, default=60.0, help="of each drive; default: %(default)g")
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(
    title="The promise on another drive",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("grade", "headwind", "torque_bias"), columns=("promised [%]", "reached on drive 2 [%]")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
