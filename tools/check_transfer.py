"""Gap closed as predicted on one drive, and as measured on another drive of the same truck.

python tools/check_transfer.py [--effect NAME ...] [--minutes 60] [--seed 1] [--json]

For each effect one simulated truck makes two drives on different roads, the effect in both. The first is diagnosed:
this gives the prediction. The second is diagnosed without and with `--effect` for the effects named on the first: this
gives the measured share. Then both are diagnosed jointly.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from real_recordings import diagnose, named, print_table, roadload, share_text

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.answers.simulation import SimulationAnswer
from estimator.errors import RoadloadError
from estimator.model.effects import BY_NAME

# Effects that the model takes without further data and that show at their usual size on one drive.
EFFECTS = ("grade", "headwind", "warm_up", "load_loss", "torque_bias", "auxiliary_load", "cornering", "sensor_drift")


@dataclass(frozen=True)
class Pair:
    """Two drives of one truck with one effect."""

    first: Path
    second: Path


def simulate_pair(effect: str, minutes: float, seed: int, folder: Path) -> Pair:
    """Write two logs of identical trucks."""
    pair = Pair(folder / f"{effect}-1.blf", folder / f"{effect}-2.blf")
    common = ["--minutes", str(minutes), "--effect", effect]
    truth = roadload(SimulationAnswer, "simulate", pair.first, *common, "--seed", str(seed)).truth
    same = ["--mass", str(truth.mass_kg), "--A", str(truth.A_N), "--C", str(truth.C_N_s2_m2)]
    roadload(SimulationAnswer, "simulate", pair.second, *common, *same, "--seed", str(seed + 1))
    return pair


def row(effect: str, pair: Pair) -> dict[str, str]:
    """Predicted share of the first drive and measured share of the second, for the effects named on the first."""
    promise = diagnose(pair.first)
    able = [name for name in named(promise) if name in BY_NAME and BY_NAME[name].is_streaming]
    plain = diagnose(pair.second)
    extended = diagnose(pair.second, *(word for name in able for word in ("--effect", name))) if able else plain
    together = diagnose(pair.first, pair.second)
    closed = [effect.gap_closed for effect in promise.effects if effect.name in able and effect.gap_closed]
    promised, low, high = (
        share_text(min(sum(getattr(each, bound) or 0.0 for each in closed), 1.0) if closed else None)
        for bound in ("fraction", "q05", "q95")
    )
    return {
        "effect": effect,
        "named on drive 1": ", ".join(named(promise)) or promise.verdict,
        "promised": promised,
        "its interval": f"{low} .. {high}" if closed else "-",
        "reached on drive 2": share_text(_reached(plain, extended)) if able else "-",
        "kW before": "-" if plain.rms_base_kW is None else f"{plain.rms_base_kW:.2f}",
        "kW after": "-" if extended.rms_base_kW is None else f"{extended.rms_base_kW:.2f}",
        "named beside it on drive 2": ", ".join(named(extended)) or extended.verdict,
        "named from both together": ", ".join(named(together)) or together.verdict,
    }


def _reached(plain: DiagnosisAnswer, extended: DiagnosisAnswer) -> float | None:
    """Closed share of the gap above the noise floor of the extended model."""
    if plain.rms_base_kW is None or extended.rms_base_kW is None or extended.noise_floor_kW is None:
        return None
    gap = plain.rms_base_kW**2 - extended.noise_floor_kW**2
    return None if gap <= 0 else 1 - (extended.rms_base_kW**2 - extended.noise_floor_kW**2) / gap


def main(arguments: list[str] | None = None) -> int:
    """Simulate, diagnose, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effect", action="append", metavar="NAME", help=f"default: {', '.join(EFFECTS)}")
    parser.add_argument("--minutes", type=float, default=60.0, help="of each drive; default: %(default)g")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    rows = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for i, effect in enumerate(options.effect or EFFECTS):
                pair = simulate_pair(effect, options.minutes, options.seed + 2 * i, Path(folder))
                rows.append(row(effect, pair))
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    if options.json:
        print(json.dumps(rows, indent=2))
    else:
        print_table("a second drive of the same truck", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
