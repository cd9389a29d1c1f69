"""Power at standstills, which shows the losses that do not depend on motion.

With an engine there is one figure for the drive: torque at idle is coarse, with the same relative error at every stop.
The power of a battery is exact, and its consumers may vary, so there is one figure for each minute with a stop.
"""

from collections.abc import Sequence

import numpy as np

from estimator.model.effects.effect import AtRest
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Role

MIN_IDLE = 30.0  # s at rest with the engine running, from which its power is used
IDLE_SD, IDLE_SHARE = 800.0, 0.15  # sd of the power at idle: [W], and share of it
INTERVAL, MIN_REST = 60.0, 5.0  # s, of a figure of a battery's power, and at rest within
# sd of a battery's power at rest: [W], and share of it. 90 minutes of rest of a BMW i3, against its heater and air
# conditioner, which switch within the minute.
REST_SD, REST_SHARE = 200.0, 0.1


def powers_at_rest(pieces: Sequence[Rows], start: float) -> tuple[AtRest, ...]:
    """Power at rest in the ``pieces`` of a drive that began at ``start`` [s]; empty if standstills are too short."""
    standing = [_standing(piece, start) for piece in pieces]
    power, engine, elapsed = (np.concatenate(parts) for parts in zip(*standing, strict=True))
    if any(Role.BATTERY_CURRENT in piece.context for piece in pieces):
        minute = np.floor(elapsed / INTERVAL)
        intervals = [minute == k for k in np.unique(minute)]
        min_duration, sd, share = MIN_REST, REST_SD, REST_SHARE
    else:
        intervals = [np.ones(len(power), dtype=np.bool_)]
        min_duration, sd, share = MIN_IDLE, IDLE_SD, IDLE_SHARE
    return tuple(
        AtRest(
            power=(median := float(np.median(power[part]))),
            sd=sd + share * abs(median),
            engine_speed=float(np.median(engine[part])),
            elapsed=float(elapsed[part].mean()),
        )
        for part in intervals
        if np.count_nonzero(part) >= min_duration / STEP
    )


def _standing(rows: Rows, start: float) -> tuple[Floats, Floats, Floats]:
    """Power [W], engine speed [rad/s] and time since the start [s] of rows at rest with the engine or motor on."""
    blank = np.full(len(rows), np.nan)
    engine = rows.context.get(Role.ENGINE_SPEED, blank)
    if Role.BATTERY_CURRENT in rows.context:
        engine, is_on = np.zeros(len(rows)), np.isfinite(rows.context[Role.BATTERY_CURRENT])
    else:
        is_on = engine > 0
    rest = (rows.speed == 0) & np.isfinite(rows.power) & is_on
    return rows.power[rest], engine[rest], rows.t[rest] - start
