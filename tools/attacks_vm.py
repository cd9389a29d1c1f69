"""Attacks on a real SocketCAN bus: python tools/attacks_vm.py [--only TEXT] [--folder FOLDER] [--write].

A drive with one attack after the other is played on a virtual CAN bus in a machine with systemd, to the service of the
Debian package, at the speed of driving: the kernel gives the times of the frames. The parameters that the service
broadcasts are compared with the truth, and the outcome of every attack with that of the same drive in process.
``--write`` puts the table into docs/adversary.md. Exit status 1 if a wrong parameter was broadcast. Needs what
tools/package_vm.py needs; 48 minutes of driving take about as long on a busy host.
"""

import argparse
import json
import sys
import tempfile
from bisect import bisect_right
from pathlib import Path

import can
from adversary import TRUCK, drive_of, write_table
from bus_attacks.sequence import Heard, Result, Values, chosen, duration, in_sequence, looked_up, of_looks, results
from bus_attacks.trial import BIASED_SD, look_at
from cantools.typechecking import DecodeResultType
from package_vm import share_package
from vm.debian import VmError, system
from vm.machine import CONSOLE, QUICK_SAMPLER, require_qemu, run

from estimator import config as configuration
from estimator.can_io.frames import Frames
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database

BEGIN = "<!-- table: tools/attacks_vm.py -->"
LONGEST = 5400.0  # s of the host
SEED = 20261123  # with this one there is an estimate after 345 s
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
STALE = 5.0  # s without a broadcast value, five of its periods, after which a receiver has none
WIDTH_SD = 3.29  # from the 5 % to the 95 % quantile of a normal distribution, in standard deviations
MESSAGES = {"RoadloadMass": "mass", "RoadloadA": "A", "RoadloadC": "C"}


def main() -> int:
    """Play, compare, print the table, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="attacks whose name contains this")
    parser.add_argument("--package", type=Path, help="the package, where it has been built (tools/build_deb.py)")
    parser.add_argument("--folder", type=Path, help="what was heard is kept here; a run that is there is not repeated")
    parser.add_argument("--timeout", type=float, default=LONGEST, help=f"s of the host, default {LONGEST:.0f}")
    parser.add_argument("--write", action="store_true", help="put the table into docs/adversary.md")
    options = parser.parse_args()
    order = [attack for attack in chosen() if options.only in attack.name]
    frames, slots = in_sequence(drive_of(duration(len(order)) / 60, SEED), order)
    with tempfile.TemporaryDirectory() as scratch:
        share = options.folder or Path(scratch)
        if not (share / "played.json").exists():
            try:
                play(frames, share, options.package, options.timeout)
            except VmError as error:
                print(f"error: {error}", file=sys.stderr)
                return 1
        config = configuration.load(share / "settings.toml")
        found = results(heard_in(share, float(frames.t[0]), float(frames.t[-1])), slots, TRUCK)
        said = summary(share, float(frames.t[-1] - frames.t[0]))
    expected = results(of_looks(look_at(frames, config)), slots, TRUCK)
    text = table(found, expected, said)
    print(text)
    if options.write:
        write_table(BEGIN, text)
    return int(any(one.worst_sd > BIASED_SD for one in found))


def play(frames: Frames, share: Path, package: Path | None, timeout: float) -> None:
    """Play the frames in the machine; what it heard is then in the folder ``share``.

    Raises
    ------
    VmError
        The machine is not available, or did not end within ``timeout`` [s]: what was heard up to then is there.
    """
    require_qemu()
    debian = system()
    share.mkdir(parents=True, exist_ok=True)
    share_package(share, package)
    write_log(frames, share / "drive.log")
    (share / "settings.toml").write_text(SETTINGS)
    code = run(["python3", "-m", "vm.attack_trial"], share, timeout=timeout, system=debian)
    if code:
        raise VmError(f"nothing was played; see {share / CONSOLE}")


def heard_in(share: Path, first: float, last: float) -> list[Heard]:
    """What was on the bus of the machine, at times of the drive, which lasted from ``first`` to ``last`` [s].

    None where the values were not available, or were not sent for STALE seconds.
    """
    played = json.loads((share / "played.json").read_text())
    ahead = played["began_s"] - first  # of the machine's clock
    database = output_database()
    layouts = {message.frame_id >> 8 & 0x3FFFF: message for message in database.messages if message.name in MESSAGES}
    times, values = [], []
    known: dict[str, tuple[float, float] | None] = dict.fromkeys(MESSAGES.values())
    for message in can.CanutilsLogReader(share / "broadcast.log"):
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

    return looked_up(at, first, last if "ended_s" in played else min(last, times[-1]))


def mean_and_sd(decoded: DecodeResultType, name: str) -> tuple[float, float] | None:
    """Mean and standard deviation of a parameter in its message; None where it is not available."""
    found = [decoded[f"{name}{what}"] for what in ("Mean", "Q05", "Q95")] if isinstance(decoded, dict) else []
    numbers = [float(one) for one in found if isinstance(one, int | float)]
    return (numbers[0], (numbers[2] - numbers[1]) / WIDTH_SD) if len(numbers) == 3 else None


def table(found: list[Result], expected: list[Result], said: str) -> str:
    """The outcomes in the machine, and those in process."""
    columns = ("attack", "outcome", "withheld after", "back after", "largest deviation", "in process")
    rows = [columns, ("---",) * len(columns)]
    for one, other in zip(found, expected, strict=False):
        there = f"{other.verdict}, {_s(other.withheld_after)}, {_s(other.back_after)}, {other.worst_sd:.1f} sd"
        name = one.slot.name.removesuffix(", in the middle")
        rows.append((name, one.verdict, _s(one.withheld_after), _s(one.back_after), f"{one.worst_sd:.1f} sd", there))
    verdicts = [one.verdict for one in found]
    counts = ", ".join(f"{kind} {verdicts.count(kind)}" for kind in ("unharmed", "withheld", "silently biased"))
    same = sum(one.verdict == other.verdict for one, other in zip(found, expected, strict=False))
    worst = max((one.worst_sd for one in found), default=0.0)
    lines = [
        f"{len(found)} attacks: {counts}; largest deviation {worst:.1f} sd. The outcome of {same} is that in process.",
        said,
        "",
        *(f"| {' | '.join(cells)} |" for cells in rows),
    ]
    return "\n".join(lines)


def summary(share: Path, length: float) -> str:
    """Lost frames and restarts, by the statuses that were written every few seconds, of ``length`` [s] of driving."""
    played = json.loads((share / "played.json").read_text())
    lines = (share / "statuses").read_text().rpartition("\n")[0].splitlines()
    statuses = [status for line in lines if (status := json.loads(line))]
    last, restarts = statuses[-1], len({status["pid"] for status in statuses}) - 1
    lost = sum(last["input"][name] for name in ("kernel_drops", "queue_drops")) + last["estimator"]["queue_drops"]
    early = f" The run was ended after {last['written_s'] - played['began_s']:,.0f} of {length:,.0f} s of driving."
    return (
        f"{lost} of {last['input']['frames']:,} received frames were lost; {restarts} restarts of the service."
        f"{'' if 'ended_s' in played else early}"
    )


def _s(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.0f} s"


if __name__ == "__main__":
    sys.exit(main())
