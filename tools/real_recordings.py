"""What the diagnosis says of real recordings whose signals are withheld and then revealed: promised against reached.

python tools/real_recordings.py [--only bmw|vt|kenworth] [--trip TripA02 ...] [--json]

* A BMW i3, 29 trips: accelerometer and elevation withheld, so the road's grade is a gap; then each of them revealed.
* A class-8 truck at 1 Hz (tools/table_to_log.py): elevation withheld, then revealed, with the mass by either.
* A Kenworth, three drives of 30 s: too short to tell anything.

The recordings are no part of the project: `shared/data` beside it, or the folder that ROADLOAD_DATA names.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.table import Table
from table import read_table
from table_to_log import convert

from estimator.errors import InputError, RoadloadError

ROOT = Path(__file__).parents[1]
LOWER_HEATING_VALUE = 42.8  # kJ/g, of diesel
EFFICIENCY = 0.42  # of the truck's engine, assumed
VT_MAP = [
    "MOTION.Speed=vel (mph)",
    f"ENGINE.Power=fuel (g/s)*{LOWER_HEATING_VALUE * EFFICIENCY:.3f}",
    "ENGINE.Speed=engine (rpm)",
    "ROAD.Elevation=elevation (m)",
]
WIDE = 180  # columns, where the output is no terminal


@dataclass(frozen=True)
class Diagnosis:
    """The answer of `roadload diagnose --json`, in the terms of a table; rms and floor [kW]."""

    verdict: str
    named: tuple[str, ...]  # effects in order of adding
    equivalent: frozenset[str]  # what the named effects cannot be told apart from
    probability: float | None  # of the first one
    promised: tuple[float, float, float] | None  # share of the gap that the first one closes: value, 5 %, 95 %
    rms_base: float | None
    rms_final: float | None
    floor: float | None
    reason: str

    @classmethod
    def of(cls, content: dict[str, Any]) -> Self:
        """Take the wanted keys from the command's answer."""
        effects = content["effects"]
        first = effects[0] if effects else None
        closed = first and first["gap_closed"]
        return cls(
            verdict=content["verdict"],
            named=tuple(effect["name"] for effect in effects),
            equivalent=frozenset(name for effect in effects for name in effect["equivalent"]),
            probability=first and first["probability"],
            promised=(closed["fraction"], closed["q05"], closed["q95"]) if closed else None,
            rms_base=content["rms_base_kW"],
            rms_final=content["rms_final_kW"],
            floor=content["noise_floor_kW"],
            reason=content.get("reason") or "",
        )

    def reached(self, rms: float | None) -> float | None:
        """Share of the gap above this diagnosis' noise floor that is closed when ``rms`` [kW] is left."""
        if rms is None or self.rms_base is None or self.floor is None or self.rms_base <= self.floor:
            return None
        return 1 - (rms**2 - self.floor**2) / (self.rms_base**2 - self.floor**2)


def data_folder() -> Path:
    """Where the recordings are.

    Raises
    ------
    InputError
        They are not there.
    """
    folder = Path(os.environ.get("ROADLOAD_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise InputError(f"no recordings at {folder}; set ROADLOAD_DATA")
    return folder


def roadload(*arguments: str | Path) -> dict[str, Any]:
    """The JSON answer of a command of the program.

    Raises
    ------
    RoadloadError
        The command failed; with its own words.
    """
    command = [sys.executable, "-m", "estimator", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise RoadloadError(lines[-1].removeprefix("error: ") if lines else f"exit status {done.returncode}")
    content: dict[str, Any] = json.loads(done.stdout)
    return content


def diagnose(*arguments: str | Path) -> Diagnosis:
    """What `roadload diagnose` says, given its arguments."""
    return Diagnosis.of(roadload("diagnose", *arguments))


def without(configuration: str, *roles: str) -> str:
    """A configuration file's text that leaves ``roles`` unbound; without an accelerometer, wheel speed leads."""
    lines = [line for line in configuration.splitlines() if line.partition("=")[0].strip() not in roles]
    if "longitudinal_acceleration" in roles:
        lines = [line for line in lines if line.partition("=")[0].strip() != "acceleration"]
    return "\n".join(lines) + "\n"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _kilowatts(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _names(diagnosis: Diagnosis) -> str:
    likely = "" if diagnosis.probability is None else f" ({_share(diagnosis.probability)})"
    return (" + ".join(diagnosis.named) + likely) if diagnosis.named else diagnosis.verdict


def _promised(diagnosis: Diagnosis) -> str:
    if diagnosis.promised is None:
        return "-"
    value, low, high = map(_share, diagnosis.promised)
    return f"{value} ({low} .. {high})"


def bmw(folder: Path, work: Path, trips: list[str]) -> Iterator[dict[str, str]]:
    """Per trip: what is named when nothing feels the road, what is promised, and what two sensors reach."""
    text = (ROOT / "dbc" / "bmw_i3.toml").read_text()
    files = {}
    for name, roles in {
        "withheld": ("longitudinal_acceleration", "altitude"),
        "elevation": ("longitudinal_acceleration",),
        "accelerometer": ("altitude",),
    }.items():
        files[name] = work / f"{name}.toml"
        files[name].write_text(without(text, *roles))
    logs = {log.stem: log for log in sorted((folder / "bmw_i3").glob("*.blf"))}
    for trip in trips or logs:
        if trip not in logs:
            raise InputError(f"--trip {trip}: no such trip; there are {', '.join(logs)}")
        log = logs[trip]
        said = {
            name: diagnose(log, "--config", file, "--dbc", folder / "bmw_i3" / "bmw_i3.dbc")
            for name, file in files.items()
        }
        withheld, elevation, felt = said["withheld"], said["elevation"], said["accelerometer"]
        yield {
            "trip": trip,
            "named, withheld": _names(withheld),
            "promised": _promised(withheld),
            "kW before": _kilowatts(withheld.rms_base),
            "kW promised": _kilowatts(withheld.rms_final),
            "kW, accelerometer": _kilowatts(felt.rms_base),
            "reached": _share(withheld.reached(felt.rms_base)),
            "named, GPS elevation": _names(elevation),
            "kW, GPS elevation": _kilowatts(elevation.rms_final),
        }


def _mass(log: Path, *arguments: str | Path) -> str:
    answer = roadload("estimate", log, *arguments)
    mass = answer["parameters"]["mass_kg"]
    return answer["status"] if mass is None else f"{mass['mean'] / 1e3:.1f} +- {mass['sd'] / 1e3:.1f}"


def vt(folder: Path, work: Path) -> Iterator[dict[str, str]]:
    """Per phase of the study: elevation withheld and revealed, with the mass [t] by either."""
    table = read_table(folder / "vt_hd_trucks" / "veh002_all.csv")
    shown = ROOT / "tools" / "vt_truck.toml"
    withheld = work / "vt_withheld.toml"
    withheld.write_text(without(shown.read_text(), "altitude"))
    dbc = ROOT / "tools" / "vt_truck.dbc"
    for phase in sorted(set(table.column("phase_num")), key=int):
        log = work / f"vt_phase{phase}.blf"
        convert(table, log, [str(dbc)], VT_MAP, None, 1.0, [f"phase_num={phase}"])
        before = diagnose(log, "--config", withheld, "--dbc", dbc)
        after = diagnose(log, "--config", shown)
        yield {
            "phase": phase,
            "named, withheld": _names(before),
            "promised": _promised(before),
            "kW before": _kilowatts(before.rms_base),
            "kW promised": _kilowatts(before.rms_final),
            "named, revealed": _names(after),
            "kW, revealed": _kilowatts(after.rms_final),
            "reached": _share(before.reached(after.rms_final)),
            "t before": _mass(log, "--config", withheld, "--dbc", dbc),
            "t, grade": _mass(log, "--config", shown, "--effect", "grade"),
        }


def kenworth(folder: Path) -> Iterator[dict[str, str]]:
    """Per drive: the verdict, which can only be that nothing can be told, and why."""
    for log in sorted((folder / "j1939_trucks" / "kenworth_t270").glob("*.log")):
        said = diagnose(log)
        yield {"drive": log.stem, "verdict": said.verdict, "named": _names(said), "why": said.reason}


def print_table(title: str, rows: list[dict[str, str]]) -> None:
    """Print rows of equal keys."""
    table = Table(title=title)
    for name in rows[0] if rows else ():
        table.add_column(name)
    for row in rows:
        table.add_row(*row.values())
    console = Console()
    (console if console.is_terminal else Console(width=WIDE)).print(table)


def main(arguments: list[str] | None = None) -> int:
    """Diagnose what is asked for and print a table for each vehicle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["bmw", "vt", "kenworth"])
    parser.add_argument("--trip", action="append", default=[], metavar="NAME", help="of the BMW; default: all")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    results: dict[str, list[dict[str, str]]] = {}
    try:
        folder = data_folder()
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            tables = {
                "bmw": lambda: bmw(folder, work, options.trip),
                "vt": lambda: vt(folder, work),
                "kenworth": lambda: kenworth(folder),
            }
            for name in [options.only] if options.only else tables:
                results[name] = list(tables[name]())
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    if options.json:
        print(json.dumps(results, indent=2))
    else:
        for name, rows in results.items():
            print_table(name, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
