"""The attacks: each adds to, or changes, the traffic of a drive during a part of it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bus_attacks import forging
from bus_attacks.forging import JUST_AFTER, between, from_address, group, later, merged, repeated, scaled
from estimator.can_io.frames import Frames

FOREIGN = 0x21  # address of an attacker with an address of its own: body controller
ENGINE = 0x00
BEFORE = 6.0  # s for which an attacker is on the bus before the vehicle
EC1_PERIOD = 5.0  # s
TORQUE = ("EEC1", "ActualEngPercentTorque")
SPEED = ("CCVS1", "WheelBasedVehicleSpeed")
ALTITUDE = ("VDS", "Altitude")
ALTITUDE_STEP, LOWEST_ALTITUDE = 0.125, -2500.0  # m, as in j1939.dbc
GNSS = 0x1C  # address of the receiver that sends VDS

Forge = Callable[[Frames, float, float], Frames]


@dataclass(frozen=True, kw_only=True)
class Attack:
    """Traffic that is not the vehicle's.

    ``apply`` takes the traffic and the times [s] from which and up to which the attack lasts; ``shares`` gives these as
    shares of the drive.
    """

    name: str
    apply: Forge
    shares: tuple[float, float]

    def on(self, drive: Frames) -> tuple[Frames, float, float]:
        """The traffic under attack, and the times [s] from which and up to which the attack lasts."""
        first, length = float(drive.t[0]), float(drive.t[-1] - drive.t[0])
        start, stop = (first + share * length for share in self.shares)
        return self.apply(drive, start, stop), start, stop


WHOLE, MIDDLE = (0.0, 1.0), (0.5, 0.58)


def attacks() -> Iterator[Attack]:
    """All attacks, from the first frame on and in the middle of the drive."""
    for when, shares in (("throughout", WHOLE), ("in the middle", MIDDLE)):
        for name, forge in _SUSTAINED.items():
            yield Attack(name=f"{name}, {when}", apply=forge, shares=shares)
    for name, forge in _FIRST.items():
        yield Attack(name=f"{name} before the vehicle's first frame", apply=forge, shares=(0.0, 0.001))
    yield Attack(name="the engine's controller changes its address", apply=_moves, shares=(0.5, 0.5))
    yield Attack(name="one foreign EC1 of 3,250 Nm", apply=partial(_one_reference, 0.0), shares=(0.5, 0.501))


def _interleaved(
    message: tuple[str, str], factor: float, drive: Frames, start: float, stop: float, *, source: int | None = None
) -> Frames:
    """As many forged frames as real ones, half a period later, from the same address or from ``source``."""
    real = between(group(drive, message[0]), start, stop)
    forged = later(scaled(real, *message, factor), np.append(np.diff(real.t), 0.0) / 2)
    return merged(drive, forged if source is None else from_address(forged, source))


def _flooded(message: tuple[str, str], factor: float, times: int, drive: Frames, start: float, stop: float) -> Frames:
    real = between(group(drive, message[0]), start, stop)
    return merged(drive, repeated(scaled(real, *message, factor), times))


def _mixed(message: tuple[str, str], factor: float, drive: Frames, start: float, stop: float) -> Frames:
    """As many forged frames as real ones on average, at random times."""
    real = between(group(drive, message[0]), start, stop)
    picked = np.sort(np.random.default_rng(1).integers(0, max(len(real), 1), len(real)))
    period = float(np.median(np.diff(real.t)))
    moved = later(scaled(real[picked], *message, factor), np.random.default_rng(2).uniform(0, period, len(real)))
    return merged(drive, moved)


def _sparse(message: tuple[str, str], factor: float, every: int, drive: Frames, start: float, stop: float) -> Frames:
    """A forged frame right after one real frame in so many."""
    real = between(group(drive, message[0]), start, stop)[::every]
    return merged(drive, later(scaled(real, *message, factor), JUST_AFTER))


def _held(message: str, hold: float, every: float, drive: Frames, start: float, stop: float) -> Frames:
    """A gateway that sends the newest payload again and again for ``hold`` seconds of ``every`` seconds."""
    real = between(group(drive, message), start, stop)
    is_real = np.isin(drive.ident, np.unique(real.ident)) & (drive.t >= start) & (drive.t < stop)
    phase = (real.t - start) % every
    place = np.maximum.accumulate(np.where(phase < hold, 0, np.arange(len(real))))
    return merged(drive[~is_real], replace(real, data=real.data[place]))


def _hills(source: int, drive: Frames, start: float, stop: float) -> Frames:
    """Altitudes of a road that rises and falls by 60 m every two minutes, half a period after the real ones."""
    real = between(group(drive, ALTITUDE[0]), start, stop)
    height = 300.0 + 60.0 * np.sin(2 * np.pi * (real.t - start) / 120.0)
    raw = np.round((height - LOWEST_ALTITUDE) / ALTITUDE_STEP).astype(np.int64)
    return merged(drive, from_address(later(forging.given(real, *ALTITUDE, raw), 0.5), source))


def _references(source: int, drive: Frames, start: float, stop: float) -> Frames:
    """A forged EC1 half a period after each real one: packets of both at a time could not be put together."""
    real = between(forging.announcements(drive, "EC1"), start, stop)
    return merged(drive, forging.reference_torque(later(real, EC1_PERIOD / 2).t, 3250.0, source))


def _one_reference(before: float, drive: Frames, start: float, stop: float) -> Frames:
    """A foreign EC1, so many seconds before the attack begins."""
    return merged(drive, forging.reference_torque(np.array([start - before]), 3250.0, FOREIGN))


def _flickering(message: str, signal: str, drive: Frames, start: float, stop: float) -> Frames:
    """A switch that reads "off" right after each real frame, whatever it read."""
    real = between(group(drive, message), start, stop)
    return merged(drive, later(forging.given(real, message, signal, np.zeros(len(real), np.int64)), JUST_AFTER))


def _first_frame(message: tuple[str, str], drive: Frames, start: float, stop: float) -> Frames:
    one = group(drive, message[0])[:1]
    return merged(drive, later(from_address(scaled(one, *message, 1.3), FOREIGN), -BEFORE))


def _moves(drive: Frames, start: float, stop: float) -> Frames:
    """All groups of the engine's controller come from another address."""
    moved = (drive.ident & 0xFF == ENGINE) & (drive.t >= start)
    return merged(drive[~moved], from_address(drive[moved], 0x01))


_SUSTAINED: dict[str, Forge] = {
    "EEC1 torque x 1.3 in turn, same address": partial(_interleaved, TORQUE, 1.3),
    "EEC1 torque x 1.1 in turn, same address": partial(_interleaved, TORQUE, 1.1),
    "EEC1 torque x 1.05 in turn, same address": partial(_interleaved, TORQUE, 1.05),
    "EEC1 torque x 1.3 at ten times the rate, same address": partial(_flooded, TORQUE, 1.3, 10),
    "EEC1 torque x 1.1 at three times the rate, same address": partial(_flooded, TORQUE, 1.1, 3),
    "EEC1 torque x 1.3 at random times, same address": partial(_mixed, TORQUE, 1.3),
    "EEC1 torque x 1.3 right after each, same address": partial(_sparse, TORQUE, 1.3, 1),
    "EEC1 engine speed x 1.2 in turn, same address": partial(_interleaved, ("EEC1", "EngSpeed"), 1.2),
    "EEC1 torque x 1.3, other address": partial(_interleaved, TORQUE, 1.3, source=FOREIGN),
    "CCVS1 speed x 1.1 in turn, same address": partial(_interleaved, SPEED, 1.1),
    "CCVS1 speed x 1.03 in turn, same address": partial(_interleaved, SPEED, 1.03),
    "CCVS1 speed x 1.1 at ten times the rate, same address": partial(_flooded, SPEED, 1.1, 10),
    "CCVS1 speed x 1.1 at random times, same address": partial(_mixed, SPEED, 1.1),
    "CCVS1 speed x 1.1, other address": partial(_interleaved, SPEED, 1.1, source=FOREIGN),
    "EEC3 friction x 3 in turn, same address": partial(_interleaved, ("EEC3", "NominalFrictionPercentTorque"), 3.0),
    "EEC3 friction 0 at ten times the rate, same address": partial(
        _flooded, ("EEC3", "NominalFrictionPercentTorque"), 0.0, 10
    ),
    "EEC1 held for 8 s of every minute": partial(_held, "EEC1", 8.0, 60.0),
    "CCVS1 held for 8 s of every minute": partial(_held, "CCVS1", 8.0, 60.0),
    "EEC1 torque x 3, one frame in forty, same address": partial(_sparse, TORQUE, 3.0, 40),
    "CCVS1 speed x 1.3, one frame in forty, same address": partial(_sparse, SPEED, 1.3, 40),
    "VDS altitude of other hills in turn, same address": partial(_hills, GNSS),
    "VDS altitude of other hills in turn, other address": partial(_hills, FOREIGN),
    "EC1 3,250 Nm after each, same address": partial(_references, ENGINE),
    "EC1 3,250 Nm after each, other address": partial(_references, FOREIGN),
    "CCVS1 brake switch off right after each, same address": partial(_flickering, "CCVS1", "BrakeSwitch"),
    "ETC1 driveline open right after each, same address": partial(_flickering, "ETC1", "TransDrivelineEngaged"),
}
_FIRST: dict[str, Forge] = {
    "one foreign EC1 of 3,250 Nm": partial(_one_reference, BEFORE),
    "one foreign EEC1": partial(_first_frame, TORQUE),
    "one foreign CCVS1": partial(_first_frame, SPEED),
}
