"""Diagnosis of real recordings with signals withheld and then revealed: predicted against measured gap closed.

    python tools/check_recordings.py [--only bmw|battery|vt|dynamometer|surrogates] [--trip TripA02 ...]
        [--surrogates N]

* A BMW i3, 29 trips: accelerometer and elevation withheld, so the road's grade is a gap; then each of them revealed.
* The same trips with the power of the battery: heater and air conditioner, which have signals, are withheld.
* A class-8 truck at 1 Hz (recordings/truck.py): elevation withheld, then revealed, with the mass by either.
* Two electric cars on a chassis dynamometer (recordings/dynamometer.py): the force at the wheels is measured.
* Surrogates of the BMW's trips, clean drives with the noise of real ones: every named effect is a false alarm.

The recordings are not part of the project: they are read from ROADLOAD_DATA.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
from harness.check import ROOT, Cells, Check, Figures, Table
from harness.drives import data_folder, diagnose, named, roadload
from harness.scores import share
from recordings import dynamometer, truck
from recordings.surrogates import COLUMNS, original, write_surrogate

from estimator import config
from estimator.answers.diagnosis import DiagnosisAnswer, Magnitude
from estimator.answers.run import Parameter, RunAnswer
from estimator.can_io.binding import load_database
from estimator.errors import InputError

MIN_ROWS = 480  # of a recording of the truck, one a second
SEED = 1  # of the surrogates
VERDICTS = ("no gap", "cannot tell", "unknown effect", "effect")
COLD, WARM = 180.0, 600.0  # s at the beginning of a trip, and at its end
Row = dict[str, Any]  # cells by column: text, or a number in the unit of the column


def share_promised(answer: DiagnosisAnswer) -> float | None:
    """Share of the squared residual that is of what is named: what exact signals of all that would remove.

    Effects that are in the model and not named are left out of the whole.
    """
    shares = {part.cause: part.share or 0.0 for part in answer.budget}
    chosen = {part.cause for part in answer.budget if part.reached_kW is not None}
    told = {"road" if name == "grade" else name for name in named(answer)}
    given = sum(shares[cause] for cause in chosen - told - {"road"})
    return sum(shares.get(name, 0.0) for name in told) / (1.0 - given) if shares else None


def share_removed(answer: DiagnosisAnswer, rms: float | None) -> float | None:
    """Share of the mean squared residual removed when ``rms`` [kW] remains."""
    return None if rms is None or not answer.rms_base_kW else 1 - (rms / answer.rms_base_kW) ** 2


def without(configuration: str, *roles: str) -> str:
    """A configuration file's text that leaves ``roles`` unbound; without an accelerometer, wheel speed leads."""
    lines = [line for line in configuration.splitlines() if line.partition("=")[0].strip() not in roles]
    if "longitudinal_acceleration" in roles:
        lines = [line for line in lines if line.partition("=")[0].strip() != "acceleration"]
    return "\n".join(lines) + "\n"


def in_percent(value: float | None) -> float | None:
    """A share [%]."""
    return None if value is None else 100 * value


def _names(answer: DiagnosisAnswer) -> str:
    if not answer.effects or answer.effects[0].probability is None:
        return " + ".join(named(answer)) or answer.verdict
    return f"{' + '.join(named(answer))} ({100 * answer.effects[0].probability:.0f} %)"


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


def bmw(folder: Path, work: Path, trips: list[str]) -> Iterator[Row]:
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
            "kW before": withheld.rms_base_kW,
            "promised [%]": in_percent(share_promised(withheld)),
            "reached [%]": in_percent(share_removed(withheld, felt.rms_final_kW)),
            "named, accelerometer": _names(felt),
            "kW reached": felt.rms_final_kW,
            "named, GPS elevation": _names(elevation),
            "kW elevation": elevation.rms_final_kW,
        }


FED = ("HeaterPower", "AirConditionerPower")  # signals of the power [kW] of what the battery feeds
FED_BY_BATTERY = ("cabin_heater", "auxiliary_load", "auxiliary_cycling")  # effects


def battery(folder: Path, trips: list[str]) -> Iterator[Row]:
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
            "kW first": float(first),
            "kW last": float(last),
            "kW falls by": float(first - last),
            "cabin heater [kW]": _size(sizes.get("cabin_heater")),
            "auxiliary load [kW]": _size(sizes.get("auxiliary_load")),
            "auxiliary cycling [kW]": _size(sizes.get("auxiliary_cycling")),
            "verdict": said.verdict.value,
            "named besides": " + ".join(name for name in named(said) if name not in FED_BY_BATTERY) or "-",
        }


def _size(found: Magnitude | None) -> list[float] | None:
    """Size [kW] and its standard deviation."""
    return None if found is None or found.value is None else [found.value / 1e3, (found.sd or 0.0) / 1e3]


def _interval(found: Parameter, unit: float = 1.0) -> list[float] | str:
    """Mean and ends of the 90 % interval in a ``unit``, or the status."""
    if found.mean is None or found.q05 is None or found.q95 is None:
        return found.status
    return [found.mean / unit, found.q05 / unit, found.q95 / unit]


def _mass(log: Path, *arguments: str | Path) -> list[float] | str:
    """Mass by `roadload estimate` [t] with its 90 % interval, or the reason why there is none."""
    return _interval(roadload(RunAnswer, "estimate", log, *arguments).parameters.mass_kg, 1e3)


def vt(folder: Path, work: Path) -> Iterator[Row]:
    """Per recording of the truck: elevation withheld and revealed, with the mass [t] of both by the estimate.

    Fuel as power includes the engine's friction, so a torque offset is in all models.
    """
    hidden = work / "truck_withheld.toml"
    hidden.write_text(without(truck.CONFIG.read_text(), "altitude"))
    friction = ("--effect", "torque_bias")
    withheld: tuple[str | Path, ...] = ("--config", hidden, *friction)
    revealed: tuple[str | Path, ...] = ("--config", truck.CONFIG, *friction)
    for name, recording in truck.recordings(truck.read(folder / "vt_hd_trucks" / "veh002_all.csv")):
        if len(recording["t"]) < MIN_ROWS:
            continue
        log = work / f"truck_{name}.csv"
        truck.write(recording, log)
        before, after = diagnose(log, *withheld), diagnose(log, *revealed)
        yield {
            "recording": name,
            "min": len(recording["t"]) / 60,
            "named, withheld": _names(before),
            "kW before": before.rms_base_kW,
            "promised [%]": in_percent(share_promised(before)),
            "reached [%]": in_percent(share_removed(before, after.rms_final_kW)),
            "named, revealed": _names(after),
            "kW revealed": after.rms_final_kW,
            "t withheld": _mass(log, *withheld),
            "t revealed": _mass(log, *revealed),
        }


def on_rolls(folder: Path, work: Path) -> Iterator[Row]:
    """Per car and model: mass, A and C with 90 % intervals, beside that of least squares of the measured force."""
    for path in sorted((folder / "argonne_d3").glob("*.txt")):
        log = work / f"{path.stem}.csv"
        dynamometer.write(path, log)
        for effects in ((), ("viscous_drag",)):
            added = [argument for effect in effects for argument in ("--effect", effect)]
            found = roadload(RunAnswer, "estimate", log, "--config", dynamometer.CONFIG, *added).parameters
            yield {
                "recording": path.stem,
                "effects": " + ".join(effects) or "-",
                "least squares [kg]": dynamometer.least_squares(path),
                "mass [kg]": _interval(found.mass_kg),
                "A [N]": _interval(found.A_N),
                "C [N s2/m2]": _interval(found.C_N_s2_m2),
            }


def surrogates(folder: Path, work: Path, trips: list[str], count: int) -> Iterator[Row]:
    """Per trip: verdicts on ``count`` clean drives in all, made of its speed and of noise with its spectrum."""
    dbc = folder / "bmw_i3" / "bmw_i3.dbc"
    text = (ROOT / "dbc" / "bmw_i3.toml").read_text()
    withheld, felt = work / "withheld.toml", work / "felt.toml"
    withheld.write_text(COLUMNS + text[text.index("[gate]") :])
    felt.write_text(without(text, "altitude").replace('"bmw_i3.dbc"', f'"{dbc}"'))
    settings = config.load(felt)
    likes = {log.stem: original(log, settings, np.random.default_rng(SEED)) for log in bmw_logs(folder, trips)}
    usable = {trip: like for trip, like in likes.items() if like is not None}
    total: Counter[str] = Counter()
    for i, (trip, like) in enumerate(usable.items()):
        said: list[DiagnosisAnswer] = []
        for k in range(i, count, len(usable)):
            log = work / f"surrogate{k}.csv"
            write_surrogate(like, log, np.random.default_rng([SEED, k]))
            said.append(diagnose(log, "--config", withheld))
            log.unlink()
        verdicts = Counter(answer.verdict.value for answer in said)
        total += verdicts
        yield (
            {"like": trip, "kW of noise": like.noise / 1e3}
            | _counted(verdicts)
            | {"named": ", ".join(_names(answer) for answer in said if answer.effects) or "-", "effect [%]": None}
        )
    alarms = share(total["effect"], total.total())
    of_all = [in_percent(x) for x in (alarms.value, alarms.low, alarms.high)]
    yield {"like": "all", "kW of noise": None} | _counted(total) | {"named": "-", "effect [%]": of_all}


def _counted(verdicts: Counter[str]) -> Row:
    return {verdict: verdicts[verdict] for verdict in VERDICTS}


PROMISED = {"bmw": "accelerometer", "vt": "elevation"}  # the sensor that shows the road


def measure(options: argparse.Namespace) -> Figures:
    """Diagnose the chosen recordings, a table for each vehicle."""
    folder = data_folder()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        tables = {
            "bmw": lambda: bmw(folder, work, options.trip),
            "battery": lambda: battery(folder, options.trip),
            "vt": lambda: vt(folder, work),
            "dynamometer": lambda: on_rolls(folder, work),
            "surrogates": lambda: surrogates(folder, work, options.trip, options.surrogates),
        }
        return {name: list(tables[name]()) for name in ([options.only] if options.only else tables)}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the choice of recordings."""
    parser.add_argument("--only", choices=["bmw", "battery", "vt", "dynamometer", "surrogates"])
    parser.add_argument("--trip", nargs="+", default=[], metavar="NAME", help="of the BMW; default: all")
    parser.add_argument("--surrogates", type=int, default=54, metavar="N", help="how many in all; default: %(default)s")


def tables(figures: Figures) -> list[Table]:
    """The promises of all vehicles and the false alarms, then a table for each vehicle."""
    kept = [_promises(name, shown, figures[name]) for name, shown in PROMISED.items() if name in figures]
    alarms = [row for row in figures.get("surrogates", []) if row["like"] == "all"]
    rows = [*kept, *({"": "surrogates", "diagnosed": _number(row), "an effect named": row["effect"]} for row in alarms)]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    summary = [{column: row.get(column) for column in columns} for row in rows]
    return [
        *([Table.of("Summary", summary)] if summary else []),
        *(Table.of(name, rows) for name, rows in figures.items()),
    ]


def _promises(name: str, shown: str, rows: list[Row]) -> Row:
    """Gap closed by the sensor that is ``shown``, less what was promised without it [points]."""
    missed = [row["reached [%]"] - row["promised [%]"] for row in rows if row["promised [%]"]]
    return {
        "": f"{name}: {shown} revealed",
        "diagnosed": sum(row["kW before"] is not None for row in rows),
        "an effect named": sum(row["named, withheld"] not in VERDICTS for row in rows),
        "promised": len(missed),
        "reached less promised, median": float(np.median(missed)) if missed else None,
        "worst [points]": min(missed, default=None),
    }


def _number(row: Row) -> int:
    return sum(row[verdict] for verdict in VERDICTS)


CHECK = Check(
    title="Real recordings",
    measure=measure,
    tables=tables,
    headline=Cells(table="Summary"),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())
