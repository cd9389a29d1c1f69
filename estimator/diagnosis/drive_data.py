"""The data of one drive for the diagnosis: every admitted sample, in order, with all context that the bus carries."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.config import Config
from estimator.diagnosis.standing import rests
from estimator.model.effects.effect import AtRest
from estimator.preparation import kinematics
from estimator.preparation.past_speed import last_known
from estimator.preparation.sample_maker import SampleMaker
from estimator.preparation.striding import Strider
from estimator.samples import STEP, Rows, Samples
from estimator.signals import Floats, Quantity
from estimator.strides import Strides

MAX_STANDING_SPEED = 0.5  # m/s
MIN_STOP = 10.0  # s, in which a load could change
BREAK = 10.0  # s of NaN between pieces of a drive, where only their order matters
MIN_KNOWN_SHARE = 0.5  # of the drive, for which a quantity must be known to be used
STATES = (Quantity.GEAR, Quantity.BRAKE, Quantity.FROZEN)  # between two of their values there is none


@dataclass(frozen=True, kw_only=True)
class Record:
    """Admitted samples of one drive, the lag [s] that was taken out, and rows not used by reason.

    It is the whole of a log, or one of several drives in it: ``log`` says which, ``log_start`` when that began [s].
    ``rests``: the power while the vehicle stood. ``strides`` are all of the same drive, for the model with the road as
    a state.
    """

    samples: Samples
    start: float  # [s] time of the first row
    lag: float
    rejected: Counter[str]
    rests: tuple[AtRest, ...]
    strides: Strides = field(default_factory=Strides.none)
    log: int = 0
    log_start: float = 0.0

    @property
    def known(self) -> frozenset[Quantity]:
        """Quantities that the samples carry."""
        density = self.samples.density
        is_air_known = np.isfinite(density).sum() > MIN_KNOWN_SHARE * len(density)
        return frozenset(self.samples.context) | ({Quantity.AIR_DENSITY} if is_air_known else set())


def record(pieces: list[Rows], config: Config) -> Record:
    """The record of a drive from its ``pieces``, each without a gap, in order of time."""
    rejected: Counter[str] = Counter()
    if not pieces:
        return Record(samples=Samples.concatenate([]), start=0.0, lag=0.0, rejected=rejected, rests=())
    gap = np.full(round(BREAK / STEP), np.nan)
    speed = np.concatenate([part for piece in pieces for part in (piece.plausible_speed, gap)])
    power = np.concatenate([part for piece in pieces for part in (piece.power, gap)])
    maker = SampleMaker(config.kinematics, config.admission)
    smoother, lag = maker.calibrate(speed, power)
    start = float(pieces[0].t[0])
    heard = _heard(pieces, start)
    whole, made = list[Rows](), list[Samples]()
    distance, stops = 0.0, 0.0
    margin = maker.margin
    for piece in pieces:
        travelled = distance + np.cumsum(np.nan_to_num(piece.plausible_speed)) * STEP
        halts = stops + _halts(piece.speed)
        distance, stops = float(travelled[-1]), float(halts[-1])
        if len(piece) <= 2 * margin:
            rejected["surroundings incomplete"] += len(piece)
            continue
        inner = slice(margin, len(piece) - margin)
        samples = maker.samples(piece, smoother, lag, heard, start)
        place = {Quantity.DISTANCE: travelled[inner], Quantity.STOPS: halts[inner]}
        made.append(replace(samples, context={**samples.context, **place}))
        whole.append(piece)
    found = [maker.admit(samples, piece, rejected) for samples, piece in zip(_bridged(made), whole, strict=True)]
    strides = _strides(pieces, config, heard, start)
    return Record(
        samples=Samples.concatenate(found),
        start=start,
        lag=lag,
        rejected=rejected,
        rests=rests(pieces, start),
        strides=strides,
        log_start=start,
    )


def _strides(pieces: list[Rows], config: Config, heard: frozenset[Quantity], start: float) -> Strides:
    """Strides of all pieces, with the whole context that was heard."""
    strider, found, stops, halted = Strider(config.admission, heard, start), list[Strides](), 0.0, list[Floats]()
    for piece in pieces:
        parts = [strider.feed(piece, Counter()), strider.finish(Counter())]
        strider.pause()
        halts = stops + _halts(piece.speed)
        for part in parts:
            found.append(part)
            halted.append(halts[np.clip(np.searchsorted(piece.t, part.t), 0, len(piece) - 1)])
        stops = float(halts[-1])
    strides = Strides.concatenate(found)
    context = {quantity: _bridge(quantity, values) for quantity, values in strides.context.items()}
    return replace(strides, context={**context, Quantity.STOPS: np.concatenate(halted)})


def _heard(pieces: list[Rows], start: float) -> frozenset[Quantity]:
    """Quantities that are known for most of the drive."""
    known: Counter[Quantity] = Counter()
    for piece in pieces:
        known.update({q: int(np.isfinite(x).sum()) for q, x in kinematics.quantities(piece, start).items()})
    least = MIN_KNOWN_SHARE * sum(len(piece) for piece in pieces)
    return frozenset(q for q, count in known.items() if count > least)


def _bridged(parts: list[Samples]) -> list[Samples]:
    """Parts of a drive, in order, with all of their context known."""
    if not parts:
        return []
    ends = np.cumsum([len(part) for part in parts])[:-1]
    whole = Samples.concatenate(parts).context
    context = {quantity: np.split(_bridge(quantity, values), ends) for quantity, values in whole.items()}
    return [replace(part, context={q: values[i] for q, values in context.items()}) for i, part in enumerate(parts)]


def _bridge(quantity: Quantity, values: Floats) -> Floats:
    """Values (n,) with what is not known on straight lines between what is; of a state, the last known one."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) in (0, len(values)):
        return values
    if quantity in STATES:
        return last_known(values, float(values[known[0]]))
    there = np.unwrap(values[known]) if quantity is Quantity.HEADING else values[known]
    return np.interp(np.arange(len(values)), known, there)


def _halts(speed: Floats) -> Floats:
    """How many standstills of at least MIN_STOP have ended before or at each row (n,)."""
    standing = np.concatenate([[False], speed < MAX_STANDING_SPEED, [False]])
    starts, ends = (
        np.flatnonzero(np.diff(standing.astype(int)) == 1),
        np.flatnonzero(np.diff(standing.astype(int)) == -1),
    )
    long = ends[(ends - starts) >= MIN_STOP / STEP]
    count: Floats = np.searchsorted(long, np.arange(len(speed)), side="right").astype(float)
    return count
