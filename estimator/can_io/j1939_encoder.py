"""Recorded drives as J1939 traffic: frames in the shipped database's layouts.

Signals that a recording lacks are sent as not available (all ones). Reference torque (EC1, 39 bytes) is sent by the
transport protocol's broadcast: one announcement (TP.CM, BAM) and six data packets (TP.DT), SAE J1939-21.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from cantools.database import Message, Signal
from numpy.typing import NDArray

from estimator.can_io.binding import load_database
from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.can_io.j1939 import PACKET_BYTES
from estimator.signals import Floats, Role, Series, Signals
from estimator.units import conversion_of

EPOCH = 1_700_000_000.0  # s, time of the first moment of every recording
ENGINE, TRANSMISSION, BRAKES, NAVIGATION = 0x00, 0x03, 0x0B, 0x1C  # source addresses
TP_CM = 0x1CECFF00  # announcement to all; source address in the low byte
TP_DT = 0x1CEBFF00  # data packet to all
BAM = 0x20  # control byte: broadcast announce message
PACKET_SPACING = 0.05  # s, the least between two packets of a broadcast (J1939-21)
NOT_AVAILABLE = 0xFF  # of a byte (J1939-71)
HIGHEST_VALID = {8: 0xFA, 16: 0xFAFF, 32: 0xFAFF_FFFF}  # raw values above mean error or not available

Payload = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Sent:
    """Message of a control unit, sent at each measurement of the first of its roles that the recording has."""

    message: str
    source: int
    signals: Mapping[str, Role]


_TRAFFIC = (
    _Sent(
        "EEC1",
        ENGINE,
        {
            "ActualEngPercentTorque": Role.TORQUE_FRACTION,
            "ActualEngPercentTorqueFractional": Role.TORQUE_FRACTION_FINE,
            "EngSpeed": Role.ENGINE_SPEED,
        },
    ),
    _Sent("EEC3", ENGINE, {"NominalFrictionPercentTorque": Role.FRICTION_FRACTION}),
    _Sent("EC1", ENGINE, {"EngReferenceTorque": Role.REFERENCE_TORQUE}),
    _Sent(
        "CCVS1",
        ENGINE,
        {
            "WheelBasedVehicleSpeed": Role.SPEED,
            "BrakeSwitch": Role.BRAKE_SWITCH,
            "ClutchSwitch": Role.CLUTCH_SWITCH,
            "ParkingBrakeSwitch": Role.PARK_BRAKE,
        },
    ),
    _Sent("ET1", ENGINE, {"EngCoolantTemperature": Role.COOLANT_TEMPERATURE}),
    _Sent(
        "AMB",
        ENGINE,
        {"AmbientAirTemperature": Role.AMBIENT_TEMPERATURE, "BarometricPressure": Role.AIR_PRESSURE},
    ),
    _Sent(
        "ETC1",
        TRANSMISSION,
        {"TransDrivelineEngaged": Role.DRIVELINE_ENGAGED, "TransShiftInProcess": Role.SHIFT_IN_PROCESS},
    ),
    _Sent("FD", ENGINE, {"FanSpeed": Role.FAN_SPEED}),
    _Sent("ETC2", TRANSMISSION, {"TransCurrentGear": Role.GEAR}),
    _Sent("EBC1", BRAKES, {"BrakePedalPosition": Role.BRAKE_PEDAL, "EBSBrakeSwitch": Role.BRAKE_SWITCH}),
    _Sent("EBC2", BRAKES, {"FrontAxleSpeed": Role.WHEEL_SPEEDS}),
    _Sent("ERC1", BRAKES, {"ActualRetarderPercentTorque": Role.RETARDER_FRACTION}),
    _Sent("SSI", BRAKES, {"PitchAngle": Role.GRADE}),
    _Sent(
        "VDC2",
        BRAKES,
        {
            "YawRate": Role.YAW_RATE,
            "LateralAcceleration": Role.LATERAL_ACCELERATION,
            "LongitudinalAcceleration": Role.LONGITUDINAL_ACCELERATION,
        },
    ),
    _Sent(
        "VDS",
        NAVIGATION,
        {
            "Altitude": Role.ALTITUDE,
            "NavigationBasedVehicleSpeed": Role.GPS_SPEED,
            "CompassBearing": Role.HEADING,
            "Pitch": Role.GRADE,
        },
    ),
    _Sent("VP", NAVIGATION, {"Latitude": Role.LATITUDE, "Longitude": Role.LONGITUDE}),
)


def frames_of(signals: Signals) -> Frames:
    """CAN frames of measured signals (times from the start of the drive [s]), in order of time from ``EPOCH``."""
    database = load_database([])
    parts = []
    sent_before: set[Role] = set()  # roles whose own message has gone out, and that do not call for another
    for sent in _TRAFFIC:
        present = {name: signals[role] for name, role in sent.signals.items() if role in signals}
        carried = {sent.signals[name] for name in present} - sent_before
        sent_before |= carried
        if carried:
            parts.append(_frames_of_message(database.get_message_by_name(sent.message), sent, present))
    frames = Frames.concatenate(parts)
    return frames[np.argsort(frames.t, kind="stable")]


def _frames_of_message(message: Message, sent: _Sent, present: Mapping[str, Series]) -> Frames:
    t = next(iter(present.values())).t
    payload = np.full((len(t), message.length), NOT_AVAILABLE, np.uint8)
    for name, series in present.items():
        signal = message.get_signal_by_name(name)
        latest = np.searchsorted(series.t, t, side="right") - 1
        raw = np.where(latest >= 0, _raw(signal, sent.signals[name], series.value[latest]), (1 << signal.length) - 1)
        _place(payload, signal, raw)
    if message.length > CLASSIC_BYTES:
        return _broadcast(t, message, sent.source, payload)
    ident = message.frame_id & ~0xFF | sent.source | EXTENDED
    return Frames(EPOCH + t, np.full(len(t), ident, np.uint32), np.full(len(t), CLASSIC_BYTES, np.uint8), payload)


def _raw(signal: Signal, role: Role, value: Floats) -> NDArray[np.int64]:
    """Convert SI values to raw integers."""
    conversion = conversion_of(signal.unit)
    if role is Role.GRADE:
        value = np.arctan(value)
    physical = value if conversion is None else (value - conversion.offset) / conversion.scale
    raw = np.round((physical - signal.offset) / signal.scale)
    highest = HIGHEST_VALID.get(signal.length, (1 << signal.length) - 1)
    finite = np.isfinite(raw)
    return np.where(finite, np.clip(np.where(finite, raw, 0), 0, highest), (1 << signal.length) - 1).astype(np.int64)


def _place(payload: Payload, signal: Signal, raw: NDArray[np.int64]) -> None:
    """Write little-endian bits into every row of ``payload`` (n, bytes)."""
    first, shift = divmod(signal.start, 8)
    word = raw << shift
    mask = ((1 << signal.length) - 1) << shift
    for k in range((shift + signal.length + 7) // 8):
        byte_mask = mask >> 8 * k & 0xFF
        column = payload[:, first + k]
        column &= 0xFF ^ byte_mask
        column |= (word >> 8 * k & byte_mask).astype(np.uint8)


def _broadcast(t: Floats, message: Message, source: int, payload: Payload) -> Frames:
    """Announcement and data packets of every row of ``payload`` (n, bytes)."""
    rows, size = payload.shape
    packets = -(-size // PACKET_BYTES)
    pgn = message.frame_id >> 8 & 0x3FFFF
    data = np.full((rows, 1 + packets, CLASSIC_BYTES), NOT_AVAILABLE, np.uint8)
    data[:, 0] = [BAM, size & 0xFF, size >> 8, packets, 0xFF, pgn & 0xFF, pgn >> 8 & 0xFF, pgn >> 16]
    padded = np.full((rows, packets * PACKET_BYTES), NOT_AVAILABLE, np.uint8)
    padded[:, :size] = payload
    data[:, 1:, 0] = np.arange(1, packets + 1)
    data[:, 1:, 1:] = padded.reshape(rows, packets, PACKET_BYTES)
    ident = np.array([TP_CM, *[TP_DT] * packets], np.uint32) | np.uint32(source) | np.uint32(EXTENDED)
    times = EPOCH + t[:, None] + PACKET_SPACING * np.arange(1 + packets)
    return Frames(
        times.ravel(),
        np.tile(ident, rows),
        np.full(times.size, CLASSIC_BYTES, np.uint8),
        data.reshape(-1, CLASSIC_BYTES),
    )
