"""Attacks on the bus of a simulated drive, one after the other.

    python tools/check_attacks.py [--minutes 25] [--seed 1] [--only TEXT]

Each attack changes the traffic of a drive of the demo's truck. The broadcast parameters are taken every 5 s of
traffic, and compared with the truth and with the drive without an attack. Exit status 1 if any attack made a wrong
parameter "estimated".
"""

import argparse
import sys
from dataclasses import asdict
from typing import Any

import numpy as np
from bus_attacks.catalogue import attacks
from bus_attacks.trial import Outcome, attempt, deviations, look_at
from harness.check import Cells, Check, Figures, Table, percent, progress
from harness.drives import drive, traffic

from estimator.can_io.frames import Frames
from estimator.commands.demo import TRUCK
from estimator.config import Config

VERDICTS = ("unharmed", "withheld", "silently biased")


def drive_of(minutes: float, seed: int) -> Frames:
    """A drive of the truck without an attack."""
    return traffic(drive(TRUCK, "mixed", minutes, np.random.default_rng(seed)))


def measure(options: argparse.Namespace) -> Figures:
    """The drive without an attack, and what became of each attack."""
    frames, config = drive_of(options.minutes, options.seed), Config()
    clean = look_at(frames, config)
    chosen = [attack for attack in attacks() if options.only in attack.name]
    outcomes = {attack.name: attempt(attack, frames, clean, TRUCK, config) for attack in progress(chosen, "attacking")}
    first = next(look.t for look in clean if look.is_estimated) - clean[0].t
    return {
        "clean": {"first_s": first, "worst_sd": max(deviations(clean, TRUCK))},
        "attacks": [record_of(name, outcome) for name, outcome in outcomes.items()],
    }


def record_of(attack: str, outcome: Outcome) -> dict[str, Any]:
    """What became of an attack."""
    figures = {name: value for name, value in asdict(outcome).items() if name != "looks"}
    return {"attack": attack, "outcome": outcome.verdict, **figures}


def tables(figures: Figures) -> list[Table]:
    """Counts of outcomes, and a row for each attack."""
    clean = figures["clean"]
    title = f"Without an attack: estimated after {clean['first_s']:.0f} s, deviation up to {clean['worst_sd']:.1f} sd"
    columns = ("attack", "outcome", "withheld after", "back after", "largest deviation, of the mass", "contested for")
    rows = [
        [
            one["attack"],
            one["outcome"],
            seconds(one["withheld_after_s"]),
            seconds(one["back_after_s"]),
            deviation(one),
            ", ".join(one["contested_for"]) or "-",
        ]
        for one in figures["attacks"]
    ]
    return [Table.of("", [{"": "all"} | counted(figures["attacks"])]), Table(title, columns, rows)]


def counted(attacks: list[dict[str, Any]]) -> dict[str, Any]:
    """How many attacks had each outcome, and the largest deviation of a parameter that was sent."""
    counts = {kind: sum(one["outcome"] == kind for one in attacks) for kind in VERDICTS}
    worst = max((one["worst_sd"] or 0.0 for one in attacks), default=0.0)
    return {"attacks": len(attacks), **counts, "largest deviation": f"{worst:.1f} sd"}


def deviation(one: dict[str, Any]) -> str:
    """The largest, in posterior standard deviations, and that of the mass as a share."""
    if one["worst_sd"] is None:
        return "no estimate"
    return f"{one['worst_sd']:.1f} sd, {percent(one['worst_share_of_mass'])}"


def seconds(value: float | None) -> str:
    """A time, or "-" where there is none."""
    return "-" if value is None else f"{value:.0f} s"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the drive and the choice of attacks."""
    parser.add_argument("--minutes", type=float, default=25.0, help="length of the drive (default: 25)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="attacks whose name contains this")


CHECK = Check(
    title="Attacks on the bus, in process",
    measure=measure,
    tables=tables,
    headline=Cells(),
    options=add_options,
    fails=lambda figures: any(one["outcome"] == VERDICTS[-1] for one in figures["attacks"]),
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
