"""One drive: its rows, strides, stops, power at rest and rejected rows by reason.

A drive is read from frames or from a table, and is all that a fit needs. `estimate` takes its rows in order, as from
the bus; `diagnose` takes its strides.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.config import Config
from estimator.model.effects.effect import AtRest
from estimator.preparation.context import quantities_of
from estimator.preparation.past_speed import last_known
from estimator.preparation.power_at_rest import powers_at_rest
from estimator.preparation.striding import Strider
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, Strides

MAX_STANDING_SPEED = 0.5  # m/s
MAX_LISTED_REASONS = 4  # reasons of unused rows that are listed
MIN_STOP = 10.0  # s, in which a load could change
MIN_KNOWN_SHARE = 0.5  # of the drive, for which a quantity must be known to be used
STATES = (Quantity.GEAR, Quantity.BRAKE, Quantity.FROZEN)  # between two of their values there is none


@dataclass(frozen=True, kw_only=True, repr=False)
class Drive:
    """One drive of a vehicle: a whole log, or one of several drives in a log.

    ``pieces`` are rows without a gap, in order of time; a diagnosis leaves them out, as it takes the strides alone.
    ``strides`` are those of all pieces, with all known context. ``rests`` hold the power at standstills,
    ``rejected`` the number of rows in no stride of known force, by reason. ``log`` is the number of the log, and
    ``log_start`` the time [s] at which it begins.
    """

    pieces: tuple[Rows, ...]
    strides: Strides
    rests: tuple[AtRest, ...]
    rejected: Counter[str]
    start: float  # [s] time of the first row
    config: Config  # that it was read with
    log: int = 0
    log_start: float = 0.0

    @classmethod
    def of(cls, pieces: Sequence[Rows], config: Config) -> "Drive":
        """Make a drive of ``pieces`` of rows, each without a gap, in order of time; without pieces, an empty drive."""
        rejected: Counter[str] = Counter()
        start = float(pieces[0].t[0]) if pieces else 0.0
        return cls(
            pieces=tuple(pieces),
            strides=_strides(pieces, config, start, rejected),
            rests=powers_at_rest(pieces, start) if pieces else (),
            rejected=rejected,
            start=start,
            config=config,
            log_start=start,
        )

    def __repr__(self) -> str:
        rows, known_strides = sum(map(len, self.pieces)), int(self.strides.known.sum())
        distance = float((self.strides.s1 - self.strides.s0).sum()) / 1e3
        reasons = self.rejected.most_common(MAX_LISTED_REASONS)
        unused = ", ".join(f"{reason} {100 * count / max(rows, 1):.0f} %" for reason, count in reasons) or "nothing"
        return f"{rows * STEP / 60:.0f} min, {distance:.1f} km, {known_strides:,} strides; not used: {unused}"

    @property
    def minutes_known(self) -> float:
        """Duration of the driving whose force is known [min]."""
        return float(self.strides.known.sum()) * DURATION / 60.0

    @property
    def known_quantities(self) -> frozenset[Quantity]:
        """Quantities that are known for at least MIN_KNOWN_SHARE of the drive."""
        columns = {
            Quantity.AIR_DENSITY: self.strides.density,
            Quantity.CLIMB_BY_GRADE: self.strides.grade,
            Quantity.CLIMB_BY_ALTITUDE: self.strides.altitude,
            Quantity.CLIMB_BY_ACCELEROMETER: self.strides.gravity[self.strides.known],
        }
        heard = {q for q, values in columns.items() if np.isfinite(values).sum() > MIN_KNOWN_SHARE * len(values)}
        return frozenset(self.strides.context) | heard


def _strides(pieces: Sequence[Rows], config: Config, start: float, rejected: Counter[str]) -> Strides:
    """Strides of all pieces, with the quantities of `_known_quantities` as context; gaps in the context are bridged."""
    if not pieces:
        return Strides.none()
    strider = Strider(config.admission, _known_quantities(pieces, start), start)
    parts, stops, stops_before = list[Strides](), list[Floats](), 0.0
    for piece in pieces:
        halts = stops_before + _stops_ended(piece.speed)
        for part in (strider.feed(piece, rejected), strider.finish(rejected)):
            parts.append(part)
            stops.append(halts[np.clip(np.searchsorted(piece.t, part.t), 0, len(piece) - 1)])
        strider.pause()
        stops_before = float(halts[-1])
    strides = Strides.concatenate(parts)
    context = {quantity: _interpolated(quantity, values) for quantity, values in strides.context.items()}
    return replace(strides, context={**context, Quantity.STOPS: np.concatenate(stops)})


def _known_quantities(pieces: Sequence[Rows], start: float) -> frozenset[Quantity]:
    """Quantities of rows that are known for more than MIN_KNOWN_SHARE of the drive."""
    rows_known: Counter[Quantity] = Counter()
    for piece in pieces:
        rows_known.update({q: int(np.isfinite(values).sum()) for q, values in quantities_of(piece, start).items()})
    least = MIN_KNOWN_SHARE * sum(len(piece) for piece in pieces)
    return frozenset(quantity for quantity, count in rows_known.items() if count > least)


def _interpolated(quantity: Quantity, values: Floats) -> Floats:
    """Values (n,) with gaps interpolated linearly; a state holds its last known value."""
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) in (0, len(values)):
        return values
    if quantity in STATES:
        return last_known(values, float(values[finite[0]]))
    measured_values = np.unwrap(values[finite]) if quantity is Quantity.HEADING else values[finite]
    return np.interp(np.arange(len(values)), finite, measured_values)


def _stops_ended(speed: Floats) -> Floats:
    """Number (n,) of standstills of at least MIN_STOP that ended before or at each row."""
    standing = np.concatenate([[False], speed < MAX_STANDING_SPEED, [False]])
    changes = np.diff(standing.astype(int))
    starts, ends = np.flatnonzero(changes == 1), np.flatnonzero(changes == -1)
    long = ends[(ends - starts) >= MIN_STOP / STEP]
    count: Floats = np.searchsorted(long, np.arange(len(speed)), side="right").astype(float)
    return count
