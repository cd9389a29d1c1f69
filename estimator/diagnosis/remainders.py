"""What is left of all drives together that no effect explains: processes, and what swings."""

from dataclasses import replace

import numpy as np

from estimator.diagnosis.averaged_residual import Grains, grains_of
from estimator.diagnosis.load_resonance import SWING, swing, with_swing
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.processes import Leftover, leftovers
from estimator.diagnosis.thresholds import Thresholds
from estimator.signals import Floats


def remainders(drives: tuple[Drive, ...]) -> tuple[Leftover, ...]:
    """Processes over all drives: evidence adds up."""
    grains = [grains_of(drive.model) for drive in drives]
    each = [{_kind(left): left for left in _all(drive, part)} for drive, part in zip(drives, grains, strict=True)]
    sizes = [len(part) for part in grains]
    samples = [len(drive.model.samples) for drive in drives]
    joined = []
    for name in each[0]:
        found = [left[name] for left in each if name in left]
        variance = sum(left[name].variance * n for left, n in zip(each, samples, strict=True) if name in left)
        joined.append(
            replace(
                found[0],
                log_bayes_factor=sum(left.log_bayes_factor for left in found),
                variance=variance / sum(samples),
                covariances=tuple(_covariance(left.get(name), size) for left, size in zip(each, sizes, strict=True)),
            )
        )
    return tuple(sorted(joined, key=lambda left: -left.log_bayes_factor))


def _covariance(left: Leftover | None, n: int) -> Floats:
    return np.zeros((n, n)) if left is None else left.covariances[0]


def beside_swing(drives: tuple[Drive, ...], left: Leftover, thresholds: Thresholds) -> tuple[Drive, ...]:
    """The drives with a mass that swings in their models, where that is what is left."""
    if not left.name.startswith(SWING) or left.log_bayes_factor < thresholds.min_log_bf_process:
        return drives
    return tuple(replace(drive, model=with_swing(drive.record, drive.model)) for drive in drives)


def _all(drive: Drive, grains: Grains) -> list[Leftover]:
    return [*leftovers(grains), swing(drive.record, drive.model, grains)]


def _kind(left: Leftover) -> str:
    """What swings is one, whatever its period."""
    return left.name.partition(" every ")[0]
