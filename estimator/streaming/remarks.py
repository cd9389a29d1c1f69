"""Remarks on probable errors of the database: ranges that drop values, and switches that say the opposite or nothing.

None prevents an estimate, and each may bias it: a wrong range drops the largest values, a switch that is read inverted
excludes the driving, and one that is never on leaves the braking in it. Remarks are shown beside the verdict.
"""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np

from estimator.can_io.binding import BoundMessage
from estimator.preparation.admission import BRAKE_PEDAL, is_braking
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.units import conversion_of

OUT_OF_RANGE = "out of range"
MIN_DROPPED = 0.01  # share of values: a few odd ones are noise
MIN_SPEED = 5.0  # m/s: nobody drives faster with the brake on, or the clutch open, for most of the time
MIN_TIME = 60.0  # s at that speed
MOSTLY = 0.5
EXCLUDING = {  # value of a switch that takes rows out of the estimate
    Role.BRAKE_SWITCH: 1,
    Role.PARK_BRAKE: 1,
    Role.CLUTCH_SWITCH: 1,
    Role.SHIFT_IN_PROCESS: 1,
    Role.DRIVELINE_ENGAGED: 0,
}


class SwitchUse:
    """Counts the rows above MIN_SPEED that each switch or the brake pedal excludes, and the stops without a brake."""

    def __init__(self) -> None:
        self._known: Counter[Role] = Counter()
        self._excluding: Counter[Role] = Counter()
        self._stops = 0
        self._is_driving, self._has_braked, self._had_no_power = False, False, False

    def feed(self, parts: Iterable[Rows]) -> None:
        """Add rows."""
        for rows in parts:
            with np.errstate(invalid="ignore"):
                fast, stands = rows.speed > MIN_SPEED, rows.speed < STEP
            for role in (*EXCLUDING, Role.BRAKE_PEDAL):
                if (values := rows.context.get(role)) is not None:
                    is_excluding = values > BRAKE_PEDAL if role is Role.BRAKE_PEDAL else values == EXCLUDING[role]
                    self._known[role] += int(np.count_nonzero(fast & np.isfinite(values)))
                    self._excluding[role] += int(np.count_nonzero(fast & is_excluding))
            self._has_braked |= bool(is_braking(rows).any())
            self._had_no_power |= bool(np.any(fast & (rows.power <= 0)))
            turns = np.concatenate([[self._is_driving], fast[fast | stands]])
            self._stops += int(np.count_nonzero(turns[:-1] & ~turns[1:]))
            self._is_driving = bool(turns[-1])

    def remarks(self, names: Mapping[Role, str]) -> list[str]:
        """One line for each signal that excludes most of the driving or no braking; ``names`` are MESSAGE.signal."""
        out = []
        for role, rows_known in self._known.items():
            share = self._excluding[role] / max(rows_known, 1)
            if rows_known * STEP >= MIN_TIME and share > MOSTLY:
                state = "on" if EXCLUDING.get(role, 1) else "off"
                what = (
                    f"{names[role]} ({role}) is {state} for {100 * share:.0f} % of the driving above {MIN_SPEED:g} m/s"
                )
                line = f'if other values mean on, write them as in [bus] states = {{ "{names[role]}" = [0] }}'
                remedy = line if role in EXCLUDING else "it should read 0 % at rest, or stay out of [signals]"
                out.append(f"{what}, which is left out; {remedy}")
        brakes = ", ".join(
            f"{names[role]} ({role})" for role in (Role.BRAKE_SWITCH, Role.BRAKE_PEDAL) if role in self._known
        )
        if brakes and self._stops > 1 and not self._has_braked:
            out.append(
                f"{brakes} never shows a brake, though the vehicle stopped {self._stops} times, so braking counts as "
                "road load; bind another signal, or take it out of [signals]"
            )
        elif not brakes and self._stops > 1 and not self._had_no_power:
            out.append(
                f"no brake is bound, and the power never falls to 0, though the vehicle stopped {self._stops} times, "
                "so braking counts as road load; bind brake_switch"
            )
        return out


def dropped_values(messages: Iterable[BoundMessage], refused: Mapping[str, int], seen: Mapping[Role, int]) -> list[str]:
    """One line for each signal whose range in the DBC drops at least the share MIN_DROPPED of values.

    Parameters
    ----------
    messages
        Messages with their bound signals.
    refused
        Counts of values by MESSAGE.signal and reason.
    seen
        Readings by role.
    """
    bound = {(f"{m.name}.{s.signal.name}", s.role): s.signal for m in messages for s in m.signals}
    places = Counter(role for _, role in bound)
    out = []
    for (path, role), signal in bound.items():
        dropped = refused.get(f"{path}: {OUT_OF_RANGE}", 0)
        share = dropped * places[role] / max(seen.get(role, 0), 1)
        if share >= MIN_DROPPED:
            low, high = signal.minimum, signal.maximum
            span = f"{low:g} .. {high:g} {signal.unit or ''}".strip()
            line = f'[bus] ranges = {{ "{path}" = [lowest, highest] }}'
            out.append(
                f"{100 * min(share, 1.0):.0f} % of the values of {path} ({role}) lie outside its range {span} and are "
                f"dropped; if the DBC is wrong there, write {line}"
            )
    return out


def constant_friction(constant: tuple[float, float, float] | None, names: Mapping[Role, str]) -> list[str]:
    """One line on a friction torque that does not change with the engine's speed, as `FrictionCurve.constant` gives."""
    if constant is None:
        return []
    rpm = conversion_of("rpm")
    assert rpm is not None
    level, low, high = constant[0], constant[1] / rpm.scale, constant[2] / rpm.scale
    name = f"{names[Role.FRICTION_FRACTION]} ({Role.FRICTION_FRACTION})"
    return [
        f"{name} is {100 * level:g} % at all engine speeds from {low:,.0f} to {high:,.0f} rpm, while the "
        "friction of an engine changes with its speed: A and C are wrong if the sender repeats an old value; bind the "
        "signals without it then"
    ]
