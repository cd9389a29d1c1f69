"""Make van.blf and van.csv: the simulated drive of a van of 2,800 kg, as frames of van.dbc and as a table.

python examples/own_vehicle/make_log.py [FOLDER]
"""

import csv
import sys
from pathlib import Path

import can
import numpy as np
from cantools.database.can import Message

from estimator.can_io.binding import load_database
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH
from estimator.can_io.log_writer import write_log
from estimator.signals import Floats, Role, Signals
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck

HERE = Path(__file__).parent
VAN = Truck(
    mass=2800.0,
    A=330.0,
    C=0.95,
    reference_torque=400.0,
    peak_torque=360.0,
    rated_power=110e3,
    friction=(12.0, 0.05, 0.0002),
    shifts_under_power=True,
)
SEED = 1
DURATION = 900.0  # s
PERIOD = 0.1  # s, of both messages
ROW = 5  # periods, of the table
WHEELS = ("FrontLeft", "FrontRight", "RearLeft", "RearRight")


def columns_of(signals: Signals) -> tuple[Floats, dict[str, Floats]]:
    """Times [s] every PERIOD, and speed [km/h], torque [N m], engine speed [rpm] and brake switch at them, by name."""
    t = np.arange(signals[Role.SPEED].t[0], signals[Role.SPEED].t[-1], PERIOD)

    def at(role: Role) -> Floats:
        return np.interp(t, signals[role].t, signals[role].value)

    indicated = (at(Role.TORQUE_FRACTION) + at(Role.TORQUE_FRACTION_FINE)) * VAN.reference_torque
    return t, {
        "Wheels": 3.6 * at(Role.SPEED),
        "Torque": indicated - VAN.friction_torque(at(Role.ENGINE_SPEED)),
        "Speed": at(Role.ENGINE_SPEED) * 30 / np.pi,
        "Brake": at(Role.BRAKE_SWITCH).round(),
    }


def frames_of(t: Floats, columns: dict[str, Floats]) -> Frames:
    """Convert `columns_of` to the messages WHEELS and DRIVE of van.dbc."""
    wheels = dict.fromkeys(WHEELS, columns["Wheels"])
    drive = {name: columns[name] for name in ("Torque", "Speed", "Brake")}
    database = load_database([str(HERE / "van.dbc")])
    contents = {database.get_message_by_name("WHEELS"): wheels, database.get_message_by_name("DRIVE"): drive}
    return Frames.from_messages(
        can.Message(
            timestamp=time, arbitration_id=message.frame_id, data=_encoded(message, columns, i), is_extended_id=False
        )
        for i, time in enumerate((EPOCH + t).tolist())
        for message, columns in contents.items()
    )


def _encoded(message: Message, columns: dict[str, Floats], i: int) -> bytes:
    return message.encode({name: float(values[i]) for name, values in columns.items()}, padding=True)


def write_table(path: Path, t: Floats, columns: dict[str, Floats]) -> None:
    """Write every fifth of `columns_of`, with the power at the shaft."""
    power = columns["Torque"] * columns["Speed"] * np.pi / 30e3
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t", "v", "P", "brake"])
        for row in zip(t[::ROW], columns["Wheels"][::ROW], power[::ROW], columns["Brake"][::ROW], strict=True):
            writer.writerow([f"{row[0]:.1f}", f"{row[1]:.2f}", f"{row[2]:.2f}", f"{row[3]:.0f}"])


def main(arguments: list[str]) -> None:
    """Simulate the drive, write the log and the table."""
    rng, folder = np.random.default_rng(SEED), Path(arguments[0]) if arguments else HERE
    recording = record(VAN, generate_route("mixed", 40.0 * DURATION, rng), DURATION, rng)
    t, columns = columns_of(recording.signals)
    write_log(frames_of(t, columns), folder / "van.blf")
    write_table(folder / "van.csv", t, columns)


if __name__ == "__main__":
    main(sys.argv[1:])
