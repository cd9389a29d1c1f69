"""Make van.blf: the simulated drive of a van of 2,800 kg, as frames of van.dbc.

python examples/own_vehicle/make_log.py [OUT.blf]
"""

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
WHEELS = ("FrontLeft", "FrontRight", "RearLeft", "RearRight")


def frames_of(signals: Signals) -> Frames:
    """Convert signals to the messages WHEELS and DRIVE of van.dbc, both every 0.1 s."""
    t = np.arange(signals[Role.SPEED].t[0], signals[Role.SPEED].t[-1], PERIOD)

    def at(role: Role) -> Floats:
        return np.interp(t, signals[role].t, signals[role].value)

    indicated = (at(Role.TORQUE_FRACTION) + at(Role.TORQUE_FRACTION_FINE)) * VAN.reference_torque
    wheels = dict.fromkeys(WHEELS, 3.6 * at(Role.SPEED))
    drive = {
        "Torque": indicated - VAN.friction_torque(at(Role.ENGINE_SPEED)),
        "Speed": at(Role.ENGINE_SPEED) * 30 / np.pi,
        "Brake": at(Role.BRAKE_SWITCH).round(),
    }
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


def main(arguments: list[str]) -> None:
    """Simulate the drive and write the log."""
    rng = np.random.default_rng(SEED)
    recording = record(VAN, generate_route("mixed", 40.0 * DURATION, rng), DURATION, rng)
    write_log(frames_of(recording.signals), Path(arguments[0]) if arguments else HERE / "van.blf")


if __name__ == "__main__":
    main(sys.argv[1:])
