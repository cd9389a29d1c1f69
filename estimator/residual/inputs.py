"""Check the inputs of a residual's diagnosis: candidate columns with priors, base, and axes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimator.components.formula import units_of
from estimator.errors import InputError
from estimator.signals import Floats

MIN_SAMPLES = 100  # of a residual: 4 of 5 stretches have to determine three scales of noise
MAX_BASE_SHARE = 0.5  # columns of the base over samples: 4 of 5 stretches have to determine them
MIN_TURN = 1e-9  # smallest singular value of the base's columns, scaled to one, that counts as independent
MIN_LEFT = 1e-12  # of a column's rms, left by projection off the base: less is rounding
MIN_STEP = 1e-6  # of the median step of time: a shorter one is a repeated time, and the noise is then nearly singular
SIZES = (1e-25, 1e25)  # of the largest value: squares of products of two cubes are then finite
TIME, NOISE, PROCESS = "time", "sensor noise", "unknown over "  # names of causes that the answer uses


@dataclass(frozen=True)
class Candidate:
    """Cause that may act: its residual (n,) at magnitude 1, and the prior N(0, ``sd``^2) of its magnitude.

    ``sd``: usual magnitude; ``positive``: the magnitude cannot be negative; ``unit``: unit of the magnitude.
    """

    column: Floats
    sd: float
    positive: bool = False
    unit: str = ""


@dataclass(frozen=True)
class Axis:
    """Quantity (n,) that the residual may depend on, and its unit, such as "m/s^2"."""

    values: Floats
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Residual at times ``t`` [s] (n,), with the base (n, b): columns of the parameters that are refitted.

    Base columns are orthogonal, with rms 1. Residual and candidates are projected off the base: no result depends on
    the part in its span, and large common parts would cancel with rounding errors. The first of ``axes`` is time.
    """

    t: Floats
    residual: Floats
    base: Floats
    candidates: Mapping[str, Candidate]
    axes: Mapping[str, Axis]

    @property
    def rms(self) -> float:
        """Root mean square of the residual."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def off_base(self, columns: Floats) -> Floats:
        """Project ``columns`` (n,) or (n, c) off the base: residuals of their least-squares fit by it."""
        return _off_base(self.base, columns)


def _off_base(base: Floats, columns: Floats) -> Floats:
    rest = columns
    for _ in range(2):  # the second projection removes the rounding of the first
        rest = rest - base @ (base.T @ rest) / len(base)
    size, left = (np.sqrt(np.mean(part**2, axis=0)) for part in (columns, rest))
    significant: Floats = np.where(left > MIN_LEFT * size, rest, 0.0)
    return significant


def checked(
    residual: Floats,
    candidates: Mapping[str, Candidate],
    time: Floats,
    base: Floats | None,
    along: Mapping[str, Axis] | None,
) -> Record:
    """Check the inputs and project them off the base.

    Raises
    ------
    InputError
        The message names the array and the reason. Arrays: too few samples, another length, times that do not ascend,
        a value that is not finite or cannot be squared, a column of zeros. Candidates and axes: a prior that is not
        positive, a reserved name, a unit that is no product of powers. Base: its columns are not independent, or
        explain the whole residual.
    """
    t, y = _array("time", time), _array("residual", residual)
    if len(y) < MIN_SAMPLES:
        raise InputError(f"residual: {len(y)} samples; at least {MIN_SAMPLES} are needed")
    _same_length("time", t, y)
    _check_steps(np.diff(t))
    if not np.any(y):
        raise InputError("residual: zero everywhere; nothing is to be explained")
    columns = _base(base, y)
    rest = _off_base(columns, y)
    if not np.any(rest):
        raise InputError("residual: the base explains all of it; nothing is to be explained")
    axes = {TIME: Axis(t - t[0], "s")} | {name: _axis(name, axis, y) for name, axis in (along or {}).items()}
    checked_candidates = {name: _candidate(name, candidate, columns) for name, candidate in candidates.items()}
    for name in sorted(checked_candidates.keys() & {NOISE, *(PROCESS + axis for axis in axes)}):
        raise InputError(f"column {name!r}: the answer uses this name; choose another one")
    return Record(t=t, residual=rest, base=columns, candidates=checked_candidates, axes=axes)


def checked_unit(what: str, unit: str) -> None:
    """Refuse a unit that is no product of powers.

    Raises
    ------
    InputError
        The message names ``what`` has this unit.
    """
    try:
        units_of(unit)
    except ValueError as error:
        raise InputError(f"{what}: {error}") from None


def _check_steps(steps: Floats) -> None:
    if not np.all(steps > 0):
        late = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise InputError(f"time: does not ascend at index {late}; sort the record, and leave out repeated times")
    shortest = int(np.argmin(steps))
    if steps[shortest] < MIN_STEP * np.median(steps):
        raise InputError(f"time: hardly ascends at index {shortest + 1}; leave out repeated times")


def _axis(name: str, axis: Axis, y: Floats) -> Axis:
    what = f"along {name!r}"
    if not isinstance(axis, Axis):
        raise InputError(f"{what}: is no Axis; give Axis(values, unit)")
    if not name.strip() or name == TIME:
        raise InputError(f"{what}: {'time is always an axis' if name else 'has no name'}; choose another name")
    values = _array(what, axis.values)
    _same_length(what, values, y)
    checked_unit(what, axis.unit)
    return Axis(values, axis.unit)


def _candidate(name: str, candidate: Candidate, base: Floats) -> Candidate:
    what = f"column {name!r}"
    if not isinstance(candidate, Candidate):
        raise InputError(f"{what}: is no Candidate; give Candidate(column, sd=...)")
    column = _array(what, candidate.column)
    _same_length(what, column, base)
    if not np.any(column):
        raise InputError(f"{what}: zero everywhere; this record cannot show it, leave it out")
    sd = float(_array(f"sd of {what}", np.asarray(candidate.sd), dimensions=0))
    if not sd > 0:
        raise InputError(f"{what}: sd is {sd}; give the usual magnitude, above 0")
    return Candidate(_off_base(base, column), sd, candidate.positive, candidate.unit)


def _base(base: Floats | None, y: Floats) -> Floats:
    """Orthogonal columns with rms 1 that span the same space as ``base``, after checks against the residual ``y``."""
    columns = np.zeros((len(y), 0)) if base is None else _array("base", base, dimensions=2)
    _same_length("base", columns, y)
    count = columns.shape[1]
    if count > MAX_BASE_SHARE * len(y):
        raise InputError(f"base: {count} columns for {len(y)} samples; at most half as many are possible")
    size = np.sqrt(np.mean(columns**2, axis=0))
    left, strength, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    if count and not (np.all(size > 0) and strength[-1] > MIN_TURN * np.sqrt(len(y))):
        raise InputError("base: its columns are not independent on this record; leave one out")
    orthogonal: Floats = left * np.sqrt(len(y))
    return orthogonal


def _array(name: str, values: Floats, dimensions: int = 1) -> Floats:
    if np.ma.is_masked(values):
        raise InputError(f"{name}: has masked values; leave such samples out")
    try:
        given = np.asarray(values)
        if given.dtype.kind in "cmM":  # complex numbers, times and dates
            raise ValueError
        array: Floats = given.astype(float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: holds what is no real number; give numbers, times in seconds") from None
    if array.ndim != dimensions:
        raise InputError(f"{name}: has {array.ndim} dimensions; {dimensions} expected")
    if not np.isfinite(array).all():
        where = f" at index {int(np.argwhere(~np.isfinite(array))[0][0])}; leave such samples out" if dimensions else ""
        raise InputError(f"{name}: not finite{where}")
    largest = float(np.max(np.abs(array), initial=0.0))
    if largest and not SIZES[0] < largest < SIZES[1]:
        raise InputError(f"{name}: the largest value is {largest:g}; choose another unit")
    return array


def _same_length(name: str, array: Floats, residual: Floats) -> None:
    if len(array) != len(residual):
        raise InputError(f"{name}: {len(array)} samples, but the residual has {len(residual)}")
