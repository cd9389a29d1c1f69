"""Attacks on a real SocketCAN bus: python tests/nightly/attacks_vm.py [--throughout] [--skip N] [--folder FOLDER]
[--write].

A drive with one attack after the other is played on a virtual CAN bus in a machine with systemd, to the service of the
Debian package, at the speed of driving: the kernel gives the times of the frames. The parameters that the service
broadcasts are compared with the truth, and the outcome of every attack with that of the same drive in process. With
``--throughout`` the attacks that begin with the drive are played instead, on a short drive each. ``--write`` puts the
table into docs/adversary.md, beside the rows there of attacks that were not played. Exit status 1 if a wrong parameter
was broadcast. Needs what tests/nightly/package_vm.py needs; 48 minutes of driving take half an hour of an idle
processor.
"""

import argparse
import json
import sys
import tempfile
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import can
from adversary import PAGE, drive_of, table_on, write_table
from bus_attacks import sequence
from bus_attacks.catalogue import Attack
from bus_attacks.sequence import OWN, Heard, Result, Slot, Values, chosen, duration, looked_up, of_looks, throughout
from bus_attacks.trial import look_at
from cantools.typechecking import DecodeResultType
from package_vm import share_package
from vm.debian import VmError, system
from vm.machine import CONSOLE, EARLY_GATE, QUICK_SAMPLER, require_qemu, run

from estimator import config as configuration
from estimator.can_io.frames import Frames
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database
from estimator.commands.demo import TRUCK

BEGIN, BEGIN_THROUGHOUT = (
    "<!-- table: tests/nightly/attacks_vm.py -->",
    "<!-- table: tests/nightly/attacks_vm.py --throughout -->",
)
LONGEST = 5400.0  # s of the host
SEED, SEED_THROUGHOUT = 20261123, 20261124  # with these there is an estimate after 345 s and, by EARLY_GATE, 200 s
# A shorter contest, so that the next attack can begin sooner; values every second, to see when they are withheld.
SETTINGS = f"""
{QUICK_SAMPLER}
[bus]
contest_s = 10.0
[transmit]
enabled = true
[publish]
value_period_s = 1.0
"""
SETTINGS_THROUGHOUT = f"{SETTINGS}{EARLY_GATE}"
STALE = 5.0  # s without a broadcast value, five of its periods, after which a receiver has none
WIDTH_SD = 3.29  # from the 5 % to the 95 % quantile of a normal distribution, in standard deviations
Row = tuple[str, ...]  # attack, outcome, withheld after, back after, largest deviation, in process
MESSAGES = {"RoadloadMass": "mass", "RoadloadA": "A", "RoadloadC": "C"}


@dataclass(frozen=True)
class Play:
    """A log for the machine: its ``name``, the traffic, and when the attacks are."""

    name: str
    frames: Frames
    slots: list[Slot]

    @property
    def first(self) -> float:
        """Time of the first frame [s]."""
        return float(self.frames.t[0])

    @property
    def last(self) -> float:
        """Time of the last frame [s]."""
        return float(self.frames.t[-1])


def main() -> int:
    """Play, compare, print the table, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--throughout", action="store_true", help="the attacks that begin with the drive")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="attacks whose name contains one")
    parser.add_argument("--skip", type=int, default=0, help="not the first so many of them")
    parser.add_argument("--first", type=int, help="so many attacks only")
    parser.add_argument("--package", type=Path, help="the package, where it has been built (deploy/build_deb.py)")
    parser.add_argument("--folder", type=Path, help="what was heard is kept here; a run that is there is not repeated")
    parser.add_argument("--timeout", type=float, default=LONGEST, help=f"s of the host, default {LONGEST:.0f}")
    parser.add_argument("--write", action="store_true", help="put the table into docs/adversary.md")
    options = parser.parse_args()
    attacks = throughout() if options.throughout else chosen()
    order = [attack for attack in attacks if any(text in attack.name for text in options.only)]
    order = order[options.skip :][: options.first]
    plays = own_drives(order) if options.throughout else one_drive(order)
    settings = SETTINGS_THROUGHOUT if options.throughout else SETTINGS
    with tempfile.TemporaryDirectory() as scratch:
        share = options.folder or Path(scratch)
        if not _played(share, plays[0]):
            try:
                play_all(plays, settings, share, options.package, options.timeout)
            except VmError as error:
                print(f"error: {error}", file=sys.stderr)
                return 1
        plays = [one for one in plays if has_ended(share, one) or not options.throughout]
        config = configuration.load(share / "settings.toml")
        judged = results_of_drives if options.throughout else results
        found, said = judged(plays, [heard_in(share, one) for one in plays]), summary(share, plays)
    rows = rows_of(found, judged(plays, [of_looks(look_at(one.frames, config)) for one in plays]))
    print(table(rows, [said]))
    if options.write:
        begin = BEGIN_THROUGHOUT if options.throughout else BEGIN
        write_table(
            begin,
            with_earlier(
                rows, said, table_on(PAGE.read_text(encoding="utf-8"), begin), [name_of(one.name) for one in attacks]
            ),
        )
    return int(any(one.is_wrong for one in found))


def one_drive(order: list[Attack]) -> list[Play]:
    """One attack after the other on one drive."""
    return [Play("", *sequence.in_sequence(drive_of(duration(len(order)) / 60, SEED), order))]


def own_drives(order: list[Attack]) -> list[Play]:
    """The drive without an attack, and the same under each of those that begin with it."""
    drive = drive_of(OWN / 60, SEED_THROUGHOUT)
    attacked = (sequence.on_a_drive(drive, attack) for attack in order)
    plays = [Play(f"-{k:02}", frames, [slot]) for k, (frames, slot) in enumerate(attacked, start=1)]
    return [Play("-00", drive, []), *plays]


def results(plays: list[Play], heard: list[list[Heard]]) -> list[Result]:
    """What became of the attacks on one drive."""
    return sequence.results(heard[0], plays[0].slots, TRUCK)


def results_of_drives(plays: list[Play], heard: list[list[Heard]]) -> list[Result]:
    """What became of each attack on a drive of its own; the first drive is the one without an attack."""
    return [
        sequence.result_on_a_drive(one, heard[0], play.slots[0], TRUCK)
        for play, one in zip(plays[1:], heard[1:], strict=True)
    ]


def play_all(plays: list[Play], settings: str, share: Path, package: Path | None, timeout: float) -> None:
    """Play the traffic in the machine; what it heard is then in the folder ``share``.

    Raises
    ------
    VmError
        The machine is not available, or did not end within ``timeout`` [s]: what was heard up to then is there.
    """
    require_qemu()
    debian = system()
    share.mkdir(parents=True, exist_ok=True)
    share_package(share, package)
    for one in plays:
        write_log(one.frames, share / f"drive{one.name}.log")
    (share / "settings.toml").write_text(settings)
    code = run(["python3", "-m", "vm.attack_trial"], share, timeout=timeout, system=debian)
    if code:
        raise VmError(f"not all was played; see {share / CONSOLE}")


def has_ended(share: Path, play: Play) -> bool:
    """Whether it was played to its end."""
    return "ended_s" in _played(share, play)


def began(share: Path, play: Play) -> float:
    """When its playing began, by the machine's clock [s]."""
    return _played(share, play)["began_s"]


def _played(share: Path, play: Play) -> dict[str, float]:
    """Empty where it was not begun, or where the machine stopped as this was written."""
    path = share / f"played{play.name}.json"
    text = path.read_text() if path.exists() else ""
    found: dict[str, float] = json.loads(text) if text else {}
    return found


def heard_in(share: Path, play: Play) -> list[Heard]:
    """What was on the bus of the machine, at times of the drive.

    None where the values were not available, or were not sent for STALE seconds.
    """
    ahead = began(share, play) - play.first  # of the machine's clock
    database = output_database()
    layouts = {message.frame_id >> 8 & 0x3FFFF: message for message in database.messages if message.name in MESSAGES}
    times, values = [], []
    known: dict[str, tuple[float, float] | None] = dict.fromkeys(MESSAGES.values())
    for message in can.CanutilsLogReader(share / f"broadcast{play.name}.log"):
        group = message.arbitration_id >> 8 & 0x3FFFF
        if group not in layouts:
            continue
        name = MESSAGES[layouts[group].name]
        known[name] = mean_and_sd(layouts[group].decode(bytes(message.data)), name.capitalize())
        times.append(message.timestamp - ahead)
        values.append({key: value for key, value in known.items() if value is not None})

    def at(t: float) -> Values | None:
        index = bisect_right(times, t) - 1
        return values[index] or None if index >= 0 and t - times[index] < STALE else None

    return looked_up(at, play.first, play.last if has_ended(share, play) else min([play.last, *times[-1:]]))


def mean_and_sd(decoded: DecodeResultType, name: str) -> tuple[float, float] | None:
    """Mean and standard deviation of a parameter in its message; None where it is not available."""
    found = [decoded[f"{name}{what}"] for what in ("Mean", "Q05", "Q95")] if isinstance(decoded, dict) else []
    numbers = [float(one) for one in found if isinstance(one, int | float)]
    return (numbers[0], (numbers[2] - numbers[1]) / WIDTH_SD) if len(numbers) == 3 else None


def name_of(attack: str) -> str:
    """The name of an attack in the table."""
    return attack.removesuffix(", in the middle").removesuffix(", throughout")


def rows_of(found: list[Result], expected: list[Result]) -> list[Row]:
    """The outcomes in the machine, and those in process."""
    return [
        (name_of(one.slot.name), one.verdict, *_figures(one), ", ".join((other.verdict, *_figures(other))))
        for one, other in zip(found, expected, strict=False)
    ]


def with_earlier(rows: list[Row], said: str, earlier: str, order: list[str]) -> str:
    """The table with the rows of an ``earlier`` one of other attacks, and with what that one said of its runs."""
    lines = earlier.strip().splitlines()
    kept = [tuple(line.strip("| ").split(" | ")) for line in lines if line.startswith("| ")]
    played = {row[0] for row in rows}
    both = [row for row in kept if row[0] in order and row[0] not in played] + rows
    runs = [line for line in lines[1:] if line and not line.startswith("|")] if len(both) > len(rows) else []
    return table(sorted(both, key=lambda row: order.index(row[0])), [*runs, said])


def table(rows: list[Row], said: list[str]) -> str:
    """The counts of the outcomes, what is said of the runs, and the rows."""
    verdicts = [row[1] for row in rows]
    counts = ", ".join(f"{kind} {verdicts.count(kind)}" for kind in ("unharmed", "withheld", "silently biased"))
    same = sum(row[1] == row[-1].split(",")[0] for row in rows)
    worst = max((float(row[4].removesuffix(" sd")) for row in rows if row[4].endswith(" sd")), default=0.0)
    head = [("attack", "outcome", "withheld after", "back after", "largest deviation", "in process"), ("---",) * 6]
    lines = [
        f"{len(rows)} attacks: {counts}; largest deviation {worst:.1f} sd. The outcome of {same} is that in process.",
        *said,
        "",
        *(f"| {' | '.join(cells)} |" for cells in (*head, *rows)),
    ]
    return "\n".join(lines)


def summary(share: Path, plays: list[Play]) -> str:
    """Lost frames and restarts, by the statuses that were written every few seconds."""
    frames = lost = restarts = 0
    length = driven = 0.0
    for play in plays:
        lines = (share / f"statuses{play.name}").read_text().rpartition("\n")[0].splitlines()
        statuses = [status for line in lines if (status := json.loads(line))]
        last, bus = statuses[-1], statuses[-1]["input"]
        frames += bus["frames"]
        lost += bus["kernel_drops"] + bus["queue_drops"] + last["estimator"]["queue_drops"]
        restarts += len({status["pid"] for status in statuses}) - 1
        length += play.last - play.first
        driven += play.last - play.first if has_ended(share, play) else last["written_s"] - began(share, play)
    early = f" The run was ended after {driven:,.0f} of {length:,.0f} s of driving." if driven < length else ""
    return f"{lost} of {frames:,} received frames were lost; {restarts} restarts of the service.{early}"


def _figures(one: Result) -> tuple[str, str, str]:
    deviation = "no estimate" if one.worst_sd is None else f"{one.worst_sd:.1f} sd"
    return _s(one.withheld_after), _s(one.back_after), deviation


def _s(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.0f} s"


if __name__ == "__main__":
    sys.exit(main())
