"""Diagnosis of real recordings with signals withheld and then revealed: predicted against measured gap closed.

python tools/real_recordings.py [--only bmw|battery|vt|dynamometer|kenworth|surrogates] [--trip TripA02 ...]
    [--surrogates N]

* A BMW i3, 29 trips: accelerometer and elevation withheld, so the road's grade is a gap; then each of them revealed.
* The same trips with the power of the battery: heater and air conditioner, which have signals, are withheld.
* A class-8 truck at 1 Hz (tools/table_to_log.py): elevation withheld, then revealed, with the mass by either.
* Two electric cars on a chassis dynamometer (tools/dynamometer.py): the force at the wheels is measured.
* A Kenworth, three drives of 30 s: too short for a diagnosis.
* Surrogates of the BMW's trips, clean drives with the noise of real ones: every named effect is a false alarm.

The recordings are not part of the project: they are read from `shared/data` beside it or from ROADLOAD_DATA.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import can
import dynamometer
import numpy as np
import vt_truck
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest
from surrogate_drives import original, write_surrogate
from table import read_table

from estimator import config
from estimator.answers.answer import Answer, decode
from estimator.answers.diagnosis import DiagnosisAnswer, Magnitude
from estimator.answers.run import Parameter, RunAnswer
from estimator.can_io.binding import load_database
from estimator.errors import InputError, RoadloadError

ROOT = Path(__file__).parents[1]
MIN_ROWS = 480  # of a recording of the truck, one a second
SEED = 1  # of the surrogates
COLD, WARM = 180.0, 600.0  # s at the beginning of a trip, and at its end
WIDE = 180  # columns, where the output is no terminal
Answers = TypeVar("Answers", bound=Answer)


def named(answer: DiagnosisAnswer) -> tuple[str, ...]:
    """Names of the effects, in order of adding."""
    return tuple(effect.name for effect in answer.effects)


def share_promised(answer: DiagnosisAnswer) -> float | None:
    """Share of the squared residual that is of what is named: what exact signals of all that would remove.

    Effects of the configuration are in the model already: their parts are left out.
    """
    shares = {part.cause: part.share or 0.0 for part in answer.budget}
    chosen = {part.cause for part in answer.budget if part.reached_kW is not None}
    told = {"road" if name == "grade" else name for name in named(answer)}
    given = sum(shares[cause] for cause in chosen - told - {"road"})
    return sum(shares.get(name, 0.0) for name in told) / (1.0 - given) if shares else None


def rms_promised(answer: DiagnosisAnswer) -> float | None:
    """Residual [kW] that exact signals of all that is named would leave."""
    share, base = share_promised(answer), answer.rms_base_kW
    return None if share is None or base is None else base * max(1.0 - share, 0.0) ** 0.5


def share_removed(answer: DiagnosisAnswer, rms: float | None) -> float | None:
    """Share of the mean squared residual removed when ``rms`` [kW] remains."""
    return None if rms is None or not answer.rms_base_kW else 1 - (rms / answer.rms_base_kW) ** 2


def data_folder() -> Path:
    """Folder of the recordings.

    Raises
    ------
    InputError
        The folder does not exist.
    """
    folder = Path(os.environ.get("ROADLOAD_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise InputError(f"no recordings at {folder}; set ROADLOAD_DATA")
    return folder


def roadload(kind: type[Answers], *arguments: str | Path) -> Answers:
    """The answer of a command of the program.

    Raises
    ------
    RoadloadError
        The command failed; the message is the command's.
    """
    command = [sys.executable, "-m", "estimator", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise RoadloadError(lines[-1].removeprefix("error: ") if lines else f"exit status {done.returncode}")
    return decode(done.stdout, kind)


def diagnose(*arguments: str | Path) -> DiagnosisAnswer:
    """The answer of `roadload diagnose` with these arguments."""
    return roadload(DiagnosisAnswer, "diagnose", *arguments)


def without(configuration: str, *roles: str) -> str:
    """A configuration file's text that leaves ``roles`` unbound; without an accelerometer, wheel speed leads."""
    lines = [line for line in configuration.splitlines() if line.partition("=")[0].strip() not in roles]
    if "longitudinal_acceleration" in roles:
        lines = [line for line in lines if line.partition("=")[0].strip() != "acceleration"]
    return "\n".join(lines) + "\n"


def share_text(value: float | None) -> str:
    """A share in per cent, for a table."""
    return "-" if value is None else f"{100 * value:.0f} %"


def _kilowatts(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _names(answer: DiagnosisAnswer) -> str:
    if not answer.effects:
        return answer.verdict
    return f"{' + '.join(named(answer))} ({share_text(answer.effects[0].probability)})"


def bmw_logs(folder: Path, trips: list[str]) -> list[Path]:
    """The logs of ``trips``, or all.

    Raises
    ------
    InputError
        There is no such trip.
    """
    logs = {log.stem: log for log in sorted((folder / "bmw_i3").glob("*.blf"))}
    unknown = [trip for trip in trips if trip not in logs]
    if unknown:
        raise InputError(f"--trip {unknown[0]}: no such trip; there are {', '.join(logs)}")
    return [logs[trip] for trip in trips or logs]


def bmw(folder: Path, work: Path, trips: list[str]) -> Iterator[dict[str, str]]:
    """Per trip: effects named without a grade signal, predicted gap closed, and gap closed with two sensors.

    The likelihood takes the acceleration from the speed, and the road from the accelerometer.
    """
    text = (ROOT / "dbc" / "bmw_i3.toml").read_text()
    texts = {
        "withheld": without(text, "longitudinal_acceleration", "altitude"),
        "elevation": without(text, "longitudinal_acceleration"),
        "accelerometer": without(text, "altitude"),
    }
    files = {name: work / f"{name}.toml" for name in texts}
    for name, content in texts.items():
        files[name].write_text(content)
    for log in bmw_logs(folder, trips):
        said = {
            name: diagnose(log, "--config", file, "--dbc", folder / "bmw_i3" / "bmw_i3.dbc")
            for name, file in files.items()
        }
        withheld, elevation, felt = said["withheld"], said["elevation"], said["accelerometer"]
        yield {
            "trip": log.stem,
            "named, withheld": _names(withheld),
            "kW before": _kilowatts(withheld.rms_base_kW),
            "kW promised": _kilowatts(rms_promised(withheld)),
            "promised": share_text(share_promised(withheld)),
            "reached": share_text(share_removed(withheld, felt.rms_final_kW)),
            "named, accelerometer": _names(felt),
            "kW reached": _kilowatts(felt.rms_final_kW),
            "kW beside": _kilowatts(rms_promised(felt)),
            "named, GPS elevation": _names(elevation),
            "kW elevation": _kilowatts(elevation.rms_final_kW),
        }


FED = ("HeaterPower", "AirConditionerPower")  # signals of the power [kW] of what the battery feeds
FED_BY_BATTERY = ("cabin_heater", "auxiliary_load", "auxiliary_cycling")  # effects


def battery(folder: Path, trips: list[str]) -> Iterator[dict[str, str]]:
    """Per trip: effects named on the battery's power, against the mean power of heater and air conditioner [kW].

    That is of the first three minutes, of the last ten, and by how much the first is larger.
    """
    dbc = folder / "bmw_i3" / "bmw_i3.dbc"
    message = load_database([str(dbc)]).get_message_by_name("ENVIRONMENT")
    for log in bmw_logs(folder, trips):
        said = diagnose(log, "--config", ROOT / "dbc" / "bmw_i3_battery.toml", "--dbc", dbc)
        with can.LogReader(log) as frames:
            sent = [frame for frame in frames if frame.arbitration_id == message.frame_id]
        t = np.array([frame.timestamp for frame in sent])
        values = [message.decode_simple(bytes(frame.data)) for frame in sent]
        fed = np.array([sum(float(str(each[name])) for name in FED) for each in values])
        first, last = fed[t < t[0] + COLD].mean(), fed[t > t[-1] - WARM].mean()
        sizes = {each.name: each.magnitude for each in said.effects if each.name in FED_BY_BATTERY}
        yield {
            "trip": log.stem,
            "kW first": f"{first:.2f}",
            "kW last": f"{last:.2f}",
            "kW falls by": f"{first - last:.2f}",
            "cabin heater [kW]": _size(sizes.get("cabin_heater")),
            "auxiliary load [kW]": _size(sizes.get("auxiliary_load")),
            "auxiliary cycling [kW]": _size(sizes.get("auxiliary_cycling")),
            "verdict": said.verdict.value,
            "named besides": " + ".join(name for name in named(said) if name not in FED_BY_BATTERY) or "-",
        }


def _size(found: Magnitude | None) -> str:
    return "-" if found is None or found.value is None else f"{found.value / 1e3:.2f} +- {(found.sd or 0.0) / 1e3:.2f}"


def _mass(log: Path, *arguments: str | Path) -> str:
    """Mass by `roadload estimate` [t] with its 90 % interval, or the reason why there is none."""
    mass = roadload(RunAnswer, "estimate", log, *arguments).parameters.mass_kg
    if mass.mean is None or mass.q05 is None or mass.q95 is None:
        return mass.status
    return f"{mass.mean / 1e3:.1f} ({mass.q05 / 1e3:.1f} .. {mass.q95 / 1e3:.1f})"


def _tonnes(answer: DiagnosisAnswer) -> str:
    base, sd = answer.parameters.base, answer.parameters.base_sd
    if base is None or sd is None or base.mass_kg is None or sd.mass_kg is None:
        return "-"
    return f"{base.mass_kg / 1e3:.1f} +- {sd.mass_kg / 1e3:.1f}"


def vt(folder: Path, work: Path) -> Iterator[dict[str, str]]:
    """Per recording of the truck: elevation withheld and revealed, with the mass [t] of both.

    The first two masses are from the diagnosis, the others from the estimate. Fuel as power includes the engine's
    friction, so a torque offset is in all models.
    """
    table = read_table(folder / "vt_hd_trucks" / "veh002_all.csv")
    shown = ROOT / "tools" / "vt_truck.toml"
    hidden = work / "vt_withheld.toml"
    hidden.write_text(without(shown.read_text(), "altitude"))
    friction = ("--effect", "torque_bias")
    withheld: tuple[str | Path, ...] = ("--config", hidden, "--dbc", vt_truck.DBC, *friction)
    revealed: tuple[str | Path, ...] = ("--config", shown, *friction)
    for name, recording in vt_truck.recordings(table):
        if len(recording) < MIN_ROWS:
            continue
        log = work / f"vt_{name}.blf"
        vt_truck.write(recording, log)
        before, after = diagnose(log, *withheld), diagnose(log, *revealed)
        yield {
            "recording": name,
            "min": f"{len(recording) / 60:.0f}",
            "named, withheld": _names(before),
            "kW before": _kilowatts(before.rms_base_kW),
            "promised": share_text(share_promised(before)),
            "reached": share_text(share_removed(before, after.rms_final_kW)),
            "named, revealed": _names(after),
            "kW revealed": _kilowatts(after.rms_final_kW),
            "t withheld": _tonnes(before),
            "t revealed": _tonnes(diagnose(log, *revealed, "--effect", "grade")),
            "estimate withheld": _mass(log, *withheld),
            "estimate revealed": _mass(log, *revealed),
        }


def on_rolls(folder: Path, work: Path) -> Iterator[dict[str, str]]:
    """Per car and model: mass, A and C with 90 % intervals, beside that of least squares of the measured force."""
    settings = ROOT / "tools" / "dynamometer.toml"
    for path in sorted((folder / "argonne_d3").glob("*.txt")):
        log = work / f"{path.stem}.blf"
        dynamometer.write(path, log)
        for effects in ((), ("viscous_drag",)):
            added = [argument for effect in effects for argument in ("--effect", effect)]
            found = roadload(RunAnswer, "estimate", log, "--config", settings, *added).parameters
            yield {
                "recording": path.stem,
                "effects": " + ".join(effects) or "-",
                "least squares [kg]": f"{dynamometer.least_squares(path):,.0f}",
                "mass [kg]": _interval(found.mass_kg, ",.0f"),
                "A [N]": _interval(found.A_N, ".1f"),
                "C [N s2/m2]": _interval(found.C_N_s2_m2, ".3f"),
            }


def _interval(found: Parameter, form: str) -> str:
    """Mean with its 90 % interval, or the status."""
    if found.mean is None or found.q05 is None or found.q95 is None:
        return found.status
    return f"{found.mean:{form}} ({found.q05:{form}} .. {found.q95:{form}})"


def kenworth(folder: Path) -> Iterator[dict[str, str]]:
    """Per drive: the verdict, expected to be "cannot tell", and its reason."""
    for log in sorted((folder / "j1939_trucks" / "kenworth_t270").glob("*.log")):
        said = diagnose(log)
        yield {"drive": log.stem, "verdict": said.verdict, "named": _names(said), "why": said.reason}


def surrogates(folder: Path, work: Path, trips: list[str], count: int) -> Iterator[dict[str, str]]:
    """Per trip: verdicts on ``count`` clean drives in all, made of its speed and of noise with its spectrum."""
    dbc = folder / "bmw_i3" / "bmw_i3.dbc"
    text = (ROOT / "dbc" / "bmw_i3.toml").read_text()
    withheld, felt = work / "withheld.toml", work / "felt.toml"
    withheld.write_text(without(text, "longitudinal_acceleration", "altitude", "ambient_temperature"))
    felt.write_text(without(text, "altitude").replace('"bmw_i3.dbc"', f'"{dbc}"'))
    settings = config.load(felt)
    likes = {log.stem: original(log, settings, np.random.default_rng(SEED)) for log in bmw_logs(folder, trips)}
    usable = {trip: like for trip, like in likes.items() if like is not None}
    total: Counter[str] = Counter()
    for i, (trip, like) in enumerate(usable.items()):
        said: list[DiagnosisAnswer] = []
        for k in range(i, count, len(usable)):
            log = work / f"surrogate{k}.blf"
            write_surrogate(like, dbc, log, np.random.default_rng([SEED, k]))
            said.append(diagnose(log, "--config", withheld, "--dbc", dbc))
            log.unlink()
        verdicts = Counter(answer.verdict.value for answer in said)
        total += verdicts
        yield (
            {"like": trip, "kW of noise": _kilowatts(like.noise / 1e3)}
            | _counted(verdicts)
            | {"named": ", ".join(_names(answer) for answer in said if answer.effects) or "-"}
        )
    alarms, drawn = total["effect"], total.total()
    interval = binomtest(alarms, drawn).proportion_ci(0.95, method="wilson")
    alarm, low, high = map(share_text, (alarms / drawn, interval.low, interval.high))
    yield {"like": "all", "kW of noise": "-"} | _counted(total) | {"named": f"in {alarm} ({low} .. {high})"}


def _counted(verdicts: Counter[str]) -> dict[str, str]:
    return {verdict: str(verdicts[verdict]) for verdict in ("no gap", "cannot tell", "unknown effect", "effect")}


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
    """Diagnose the chosen recordings and print a table for each vehicle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["bmw", "battery", "vt", "dynamometer", "kenworth", "surrogates"])
    parser.add_argument("--trip", action="append", default=[], metavar="NAME", help="of the BMW; default: all")
    parser.add_argument("--surrogates", type=int, default=54, metavar="N", help="how many in all; default: %(default)s")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    if options.surrogates < 1:
        parser.error(f"--surrogates: {options.surrogates} is not a positive number")
    results: dict[str, list[dict[str, str]]] = {}
    try:
        folder = data_folder()
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            tables = {
                "bmw": lambda: bmw(folder, work, options.trip),
                "battery": lambda: battery(folder, options.trip),
                "vt": lambda: vt(folder, work),
                "dynamometer": lambda: on_rolls(folder, work),
                "kenworth": lambda: kenworth(folder),
                "surrogates": lambda: surrogates(folder, work, options.trip, options.surrogates),
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
