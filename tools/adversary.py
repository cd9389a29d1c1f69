"""Attacks on the bus of a simulated drive, one after the other: python tools/adversary.py [--minutes 25] [--write].

Each attack changes the traffic of a drive of the demo's truck. The broadcast parameters are taken every 5 s of
traffic, and compared with the truth and with the drive without an attack. ``--write`` puts the table into
docs/adversary.md. Exit status 1 if any attack made a wrong parameter "estimated".
"""

import argparse
import re
import sys
from pathlib import Path

import numpy as np
from bus_attacks.catalogue import Attack, attacks
from bus_attacks.trial import BIASED_SD, Look, Outcome, attempt, deviations, look_at

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.commands.demo import TRUCK
from estimator.config import Config
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route

METRES_PER_MINUTE = 2000.0
PAGE = Path(__file__).resolve().parents[1] / "docs" / "adversary.md"
BEGIN, END = "<!-- table: tools/adversary.py -->", "<!-- end of table -->"
COLUMNS = ("attack", "outcome", "withheld after", "back after", "largest deviation, of the mass", "contested for")


def main() -> int:
    """Run the attacks, print the table, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=25.0, help="length of the drive (default: 25)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="attacks whose name contains this")
    parser.add_argument("--write", action="store_true", help="put the table into docs/adversary.md")
    options = parser.parse_args()
    drive, config = drive_of(options.minutes, options.seed), Config()
    clean = look_at(drive, config)
    rows, outcomes = [_line(*COLUMNS), _line(*["---"] * len(COLUMNS))], []
    for attack in attacks():
        if options.only in attack.name:
            outcomes.append(attempt(attack, drive, clean, TRUCK, config))
            rows.append(row(attack, outcomes[-1]))
            print(rows[-1], flush=True)
    table = "\n".join([*summary(clean, outcomes), "", *rows])
    print(table.partition("\n\n")[0])
    if options.write:
        write_table(BEGIN, table)
    return int(any(outcome.worst_sd > BIASED_SD for outcome in outcomes))


def row(attack: Attack, outcome: Outcome) -> str:
    """One line of the table."""
    deviation = f"{outcome.worst_sd:.1f} sd, {100 * outcome.worst_share:.1f} %" if outcome.looks else "no estimate"
    reasons = ", ".join(sorted(outcome.reasons)) or "-"
    return _line(
        attack.name, outcome.verdict, _s(outcome.withheld_after), _s(outcome.recovered_after), deviation, reasons
    )


def summary(clean: list[Look], outcomes: list[Outcome]) -> list[str]:
    """The counts of all outcomes, and the drive they are compared with."""
    verdicts = [outcome.verdict for outcome in outcomes]
    worst = max(deviations(clean, TRUCK))
    first = next(look.t for look in clean if look.is_estimated) - clean[0].t
    counts = ", ".join(f"{kind} {verdicts.count(kind)}" for kind in ("unharmed", "withheld", "silently biased"))
    return [
        f"{len(verdicts)} attacks: {counts}; largest deviation {max(o.worst_sd for o in outcomes):.1f} sd.",
        f"Without an attack the drive is estimated after {first:.0f} s and deviates by at most {worst:.1f} sd.",
    ]


def write_table(begin: str, table: str) -> None:
    """Put a table into the page, between the line ``begin`` and the next END."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(begin)
    PAGE.write_text(f"{before}{begin}\n\n{table}\n\n{END}{rest.partition(END)[2]}", encoding="utf-8")


def table_on(page: str, begin: str) -> str:
    """The table of a page after the line ``begin``."""
    return page.partition(begin)[2].partition(END)[0]


def names_on(page: str) -> list[str]:
    """The attacks in the table of a page, in order."""
    table = table_on(page, BEGIN)
    return [cells[1] for line in table.splitlines() if len(cells := re.split(r" ?\| ?", line)) == 8][2:]


def drive_of(minutes: float, seed: int) -> Frames:
    """A drive of the truck without an attack."""
    rng = np.random.default_rng(seed)
    route = generate_route("mixed", minutes * METRES_PER_MINUTE, rng)
    return frames_of(record(TRUCK, route, minutes * 60, rng).signals)


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _s(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.0f} s"


if __name__ == "__main__":
    sys.exit(main())
