"""What a residual may be explained by, checked: candidate columns with priors, and axes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimator.errors import InputError
from estimator.signals import Floats

MIN_SAMPLES = 100  # of a residual: its noise has three scales, and 3 of 4 stretches have to tell them
MIN_TURN = 1e-9  # smallest singular value of the base's columns, scaled to one, that counts as independent


@dataclass(frozen=True)
class Candidate:
    """A cause that may act: the residual (n,) it gives at magnitude 1, and the prior N(0, ``sd``^2) of its magnitude.

    ``sd`` is the magnitude that is usual; ``positive``: it cannot be negative. ``unit`` is that of the magnitude.
    """

    column: Floats
    sd: float
    positive: bool = False
    unit: str = ""


@dataclass(frozen=True)
class Axis:
    """A quantity that the residual may depend on (n,), and its unit, as in "m/s^2"."""

    values: Floats
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Record:
    """A residual at times ``t`` [s], beside the columns of the parameters that its model would fit anew; (n,), (n, b).

    ``axes`` begin with time.
    """

    t: Floats
    residual: Floats
    base: Floats
    candidates: Mapping[str, Candidate]
    axes: Mapping[str, Axis]

    @property
    def rms(self) -> float:
        """Of the residual, off the base."""
        return float(np.sqrt(np.mean(self.off(self.residual) ** 2)))

    def off(self, columns: Floats) -> Floats:
        """What the base cannot fit of ``columns`` (n,) or (n, c), by least squares."""
        if not self.base.shape[1]:
            return columns
        rest: Floats = columns - self.base @ np.linalg.lstsq(self.base, columns, rcond=None)[0]
        return rest


def checked(
    residual: Floats,
    candidates: Mapping[str, Candidate],
    time: Floats,
    base: Floats | None,
    along: Mapping[str, Axis] | None,
) -> Record:
    """The record, its base scaled to columns of rms 1.

    Raises
    ------
    InputError
        Naming the array: too few samples, a length that differs, a value that is not finite, times that do not ascend,
        a column of zeros, a prior that is not positive, or a base whose columns are not independent.
    """
    t, y = _array("time", time), _array("residual", residual)
    if len(y) < MIN_SAMPLES:
        raise InputError(f"residual: {len(y)} samples; at least {MIN_SAMPLES} are needed")
    _same_length("time", t, y)
    if not np.all(np.diff(t) > 0):
        late = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        raise InputError(f"time: does not ascend at index {late}; sort the record, and leave out repeated times")
    if not np.any(y):
        raise InputError("residual: zero everywhere; nothing is to be explained")
    found = {name: _candidate(name, candidate, y) for name, candidate in candidates.items()}
    axes = {"time": Axis(t - t[0], "s")}
    for name, axis in (along or {}).items():
        values = _array(f"along {name!r}", axis.values)
        _same_length(f"along {name!r}", values, y)
        axes[name] = Axis(values, axis.unit)
    return Record(t=t, residual=y, base=_base(base, y), candidates=found, axes=axes)


def _candidate(name: str, candidate: Candidate, y: Floats) -> Candidate:
    column = _array(f"column {name!r}", candidate.column)
    _same_length(f"column {name!r}", column, y)
    if not np.any(column):
        raise InputError(f"column {name!r}: zero everywhere; this record cannot show it, leave it out")
    if not (np.isfinite(candidate.sd) and candidate.sd > 0):
        raise InputError(f"column {name!r}: sd is {candidate.sd}; give the usual magnitude, above 0")
    return Candidate(column, float(candidate.sd), candidate.positive, candidate.unit)


def _base(base: Floats | None, y: Floats) -> Floats:
    if base is None:
        return np.zeros((len(y), 0))
    columns = _array("base", base, dimensions=2)
    _same_length("base", columns, y)
    size = np.sqrt(np.mean(columns**2, axis=0))
    if not np.all(size > 0) or np.linalg.svd(columns / size, compute_uv=False)[-1] < MIN_TURN * np.sqrt(len(y)):
        raise InputError("base: its columns are not independent on this record; leave one out")
    scaled: Floats = columns / size
    return scaled


def _array(name: str, values: Floats, dimensions: int = 1) -> Floats:
    array = np.asarray(values, dtype=float)
    if array.ndim != dimensions:
        raise InputError(f"{name}: has {array.ndim} dimensions; {dimensions} expected")
    if not np.isfinite(array).all():
        first = int(np.argwhere(~np.isfinite(array))[0][0])
        raise InputError(f"{name}: not finite at index {first}; leave such samples out")
    return array


def _same_length(name: str, array: Floats, residual: Floats) -> None:
    if len(array) != len(residual):
        raise InputError(f"{name}: {len(array)} samples, but the residual has {len(residual)}")
