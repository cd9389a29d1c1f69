"""Sign of the current with which a battery drives the vehicle, as a log shows it.

Acceleration takes power and braking takes less, or gives some back. Power and change of kinetic energy so go together,
uphill and downhill, and whatever share is regained: their correlation is 0.81 to 0.97 in 29 trips of a BMW i3.
"""

from pathlib import Path
from typing import Literal

import numpy as np

from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.samples import STEP, Rows
from estimator.signals import Floats
from estimator.streaming.drive_extraction import rows_of
from estimator.streaming.log_frames import LogFrames, Progress, no_progress
from estimator.streaming.row_stream import RowStream

PART = round(1.0 / STEP)  # rows whose mean counts: within 1 s the power and the speed of one moment may come apart
MIN_SPEED = 1.0  # m/s, of driving
MIN_PARTS = 60  # of driving: a minute has some changes of speed
MIN_CORRELATION = 0.5  # no minute of the i3 shows the wrong sign; some that are nearly uniform show none

Sign = Literal["positive", "negative"]


def discharge_sign(path: Path, config: Config, progress: Progress = no_progress) -> Sign | None:
    """Sign of the battery current that drives the vehicle; None where the log does not show it.

    ``config`` binds the current, and leaves ``vehicle.discharge_current`` positive.
    """
    try:
        drives = rows_of(LogFrames([path], config, progress), RowStream(config), str(path))
    except RoadloadError:  # the log cannot feed the model, as `roadload check` says
        return None
    parts = [_parts(rows) for drive in drives for rows in drive if len(rows) >= 2 * PART]
    if not parts:
        return None
    power, gain = np.concatenate(parts, axis=1)
    if len(power) < MIN_PARTS or not power.std() * gain.std() > 0:
        return None
    correlation = float(np.corrcoef(power, gain)[0, 1])
    if not abs(correlation) >= MIN_CORRELATION:
        return None
    return "positive" if correlation > 0 else "negative"


def _parts(rows: Rows) -> Floats:
    """Mean power [W] and rate of the kinetic energy by mass [W/kg], (2, n), of seconds of driving in rows."""
    n = len(rows) // PART * PART
    speed, power = (values[:n].reshape(-1, PART).mean(axis=1) for values in (rows.speed, rows.power))
    gain = np.gradient(speed**2 / 2)
    known = np.isfinite(power) & np.isfinite(gain) & (speed > MIN_SPEED)
    return np.array([power[known], gain[known]])
