"""Attacks on a real SocketCAN bus, one after the other.

    python tests/nightly/attacks_vm.py [--throughout] [--skip N] [--folder FOLDER] [--out]

A drive with one attack after the other is played on a virtual CAN bus, at the speed of driving. The Debian package's
service hears it in a machine with systemd, and the kernel gives the times of the frames. The parameters that the
service broadcasts are compared with the truth, and the outcome of every attack with that of the same drive in process.
With ``--throughout`` the attacks that begin with the drive are played instead, on a short drive each. Attacks that are
not played keep what results/attacks_vm.json has of them. Exit status 1 if a wrong parameter was broadcast. Needs what
package_vm.py needs; 48 minutes of driving take half an hour of an idle processor.
"""

import argparse
import json
import sys
import tempfile
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import attack_sequence as sequence
import can
from attack_sequence import OWN, Heard, Result, Slot, Values, chosen, duration, looked_up, of_looks, throughout
from bus_attacks.catalogue import Attack
from bus_attacks.trial import look_at
from cantools.typechecking import DecodeResultType
from check_attacks import VERDICTS, counted, drive_of, seconds
from harness.check import RESULTS, Cells, Check, Figures, Table
from package_vm import share_package
from vm.debian import VmError, system
from vm.machine import CONSOLE, EARLY_GATE, QUICK_SAMPLER, require_qemu, run

from estimator import config as configuration
from estimator.can_io.frames import Frames
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database
from estimator.commands.demo import TRUCK
from estimator.errors import RoadloadError

IN_TURN, THROUGHOUT = "one after the other", "throughout"
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
Row = dict[str, Any]  # what became of an attack, on the bus and in process
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


def measure(options: argparse.Namespace) -> Figures:
    """Play, and compare."""
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
                raise RoadloadError(str(error)) from error
        plays = [one for one in plays if has_ended(share, one) or not options.throughout]
        config = configuration.load(share / "settings.toml")
        judged = results_of_drives if options.throughout else results
        found, said = judged(plays, [heard_in(share, one) for one in plays]), summary(share, plays)
    rows = rows_of(found, judged(plays, [of_looks(look_at(one.frames, config)) for one in plays]))
    kept = RESULTS / f"{CHECK.name}.json"
    earlier: Figures = json.loads(kept.read_bytes())["figures"] if kept.exists() else {}
    name = THROUGHOUT if options.throughout else IN_TURN
    told = {"wrong": any(one.is_wrong for one in found)}
    return earlier | {name: with_earlier(rows, said, earlier.get(name), [name_of(one.name) for one in attacks])} | told


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the choice of attacks and the machine."""
    parser.add_argument("--throughout", action="store_true", help="the attacks that begin with the drive")
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="attacks whose name contains one")
    parser.add_argument("--skip", type=int, default=0, help="not the first so many of them")
    parser.add_argument("--first", type=int, help="so many attacks only")
    parser.add_argument("--package", type=Path, help="the package, where it has been built (deploy/build_deb.py)")
    parser.add_argument("--folder", type=Path, help="what was heard is kept here; a run that is there is not repeated")
    parser.add_argument("--timeout", type=float, default=LONGEST, help=f"s of the host, default {LONGEST:.0f}")


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
        {"attack": name_of(one.slot.name), **_figures(one), "in_process": _figures(other)}
        for one, other in zip(found, expected, strict=False)
    ]


def with_earlier(rows: list[Row], said: str, earlier: Figures | None, order: list[str]) -> Figures:
    """The rows with ``earlier`` ones of other attacks, and with what was said of those runs."""
    played = {row["attack"] for row in rows}
    kept = [row for row in (earlier or {}).get("attacks", []) if row["attack"] in order and row["attack"] not in played]
    runs = earlier["runs"] if earlier and kept else []
    return {"runs": [*runs, said], "attacks": sorted([*kept, *rows], key=lambda row: order.index(row["attack"]))}


def tables(figures: Figures) -> list[Table]:
    """Counts of the outcomes with what is said of the runs, and the attacks in turn and throughout."""
    there = {name: figures[name] for name in (IN_TURN, THROUGHOUT) if name in figures}
    return [
        Table.of("", [{"": name} | summed(found) for name, found in there.items()]),
        *(table(name, found["attacks"]) for name, found in there.items()),
    ]


def summed(figures: Figures) -> Row:
    """Counts of the outcomes, and what is said of the runs."""
    rows = figures["attacks"]
    same = sum(row["outcome"] == row["in_process"]["outcome"] for row in rows)
    return {**counted(rows), "outcome as in process": same, "runs": " ".join(figures["runs"])}


def table(name: str, rows: list[Row]) -> Table:
    """A row for each attack."""
    columns = ("attack", "outcome", "withheld after", "back after", "largest deviation", "in process")
    return Table(name, columns, [[row["attack"], *_words(row), ", ".join(_words(row["in_process"]))] for row in rows])


def _figures(one: Result) -> Row:
    return {
        "outcome": one.verdict,
        "withheld_after_s": one.withheld_after,
        "back_after_s": one.back_after,
        "worst_sd": one.worst_sd,
    }


def _words(row: Row) -> tuple[str, str, str, str]:
    deviation = "no estimate" if row["worst_sd"] is None else f"{row['worst_sd']:.1f} sd"
    return row["outcome"], seconds(row["withheld_after_s"]), seconds(row["back_after_s"]), deviation


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


CHECK = Check(
    title="Attacks on a SocketCAN bus",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("attacks", *VERDICTS, "largest deviation")),
    options=add_options,
    fails=lambda figures: bool(figures["wrong"]),
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
