"""Attacks on the bus of a simulated drive, one after the other.

    python tools/check_attacks.py [--minutes 25] [--seed 1] [--only TEXT]

Each attack changes the traffic of a drive of the demo's truck. The broadcast parameters are taken every 5 s of
traffic, and compared with the truth and with the drive without an attack. Exit status 1 if any attack made a wrong
parameter "estimated".
"""

import argparse
import sys
from typing import Any

import numpy as np
from bus_attacks.catalogue import attacks
from bus_attacks.trial import BIASED_SD, Outcome, attempt, deviations, look_at
from harness.check import Check, Figures, Table, percent, progress
from harness.drives import METRES_PER_MINUTE, traffic

from estimator.can_io.frames import Frames
from estimator.commands.demo import TRUCK
from estimator.config import Config
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route

VERDICTS = ("unharmed", "withheld", "silently biased")


def drive_of(minutes: float, seed: int) -> Frames:
    """A drive of the truck without an attack."""
    rng = np.random.default_rng(seed)
    route = generate_route("mixed", minutes * METRES_PER_MINUTE, rng)
    return traffic(record(TRUCK, route, minutes * 60, rng))


def measure(options: argparse.Namespace) -> Figures:
    """The drive without an attack, and what became of each attack."""
    drive, config = drive_of(options.minutes, options.seed), Config()
    clean = look_at(drive, config)
    chosen = [attack for attack in attacks() if options.only in attack.name]
    outcomes = {attack.name: attempt(attack, drive, clean, TRUCK, config) for attack in progress(chosen, "attacking")}
    first = next(look.t for look in clean if look.is_estimated) - clean[0].t
    return {
        "clean": {"first_s": first, "worst_sd": max(deviations(clean, TRUCK))},
        "attacks": [record_of(name, outcome) for name, outcome in outcomes.items()],
    }


def record_of(attack: str, outcome: Outcome) -> dict[str, Any]:
    """What became of an attack."""
    return {
        "attack": attack,
        "outcome": outcome.verdict,
        "withheld_after_s": outcome.withheld_after,
        "back_after_s": outcome.recovered_after,
        "worst_sd": outcome.worst_sd if outcome.looks else None,
        "worst_share_of_mass": outcome.worst_share if outcome.looks else None,
        "contested_for": sorted(outcome.reasons),
    }


def tables(figures: Figures) -> list[Table]:
    """Counts of outcomes, and a row for each attack."""
    found, clean = figures["attacks"], figures["clean"]
    counts = ", ".join(f"{kind} {sum(one['outcome'] == kind for one in found)}" for kind in VERDICTS)
    worst = max((one["worst_sd"] or 0.0 for one in found), default=0.0)
    title = (
        f"{len(found)} attacks: {counts}; largest deviation {worst:.1f} sd, without an attack {clean['worst_sd']:.1f} "
        f"sd; the drive is estimated after {clean['first_s']:.0f} s"
    )
    columns = ("attack", "outcome", "withheld after", "back after", "largest deviation, of the mass", "contested for")
    rows = [
        [
            one["attack"],
            one["outcome"],
            seconds(one["withheld_after_s"]),
            seconds(one["back_after_s"]),
            "no estimate"
            if one["worst_sd"] is None
            else f"{one['worst_sd']:.1f} sd, {percent(one['worst_share_of_mass'])}",
            ", ".join(one["contested_for"]) or "-",
        ]
        for one in found
    ]
    return [Table(title, columns, rows)]


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


def is_biased(figures: Figures) -> bool:
    """Whether an attack made a wrong parameter "estimated"."""
    return any((one["worst_sd"] or 0.0) > BIASED_SD for one in figures["attacks"])


CHECK = Check(name="attacks", about=__doc__, measure=measure, tables=tables, options=add_options, fails=is_biased)

if __name__ == "__main__":
    sys.exit(CHECK.main())
