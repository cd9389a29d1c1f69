"""Nameless processes and swinging masses in the residuals of all drives together."""

from dataclasses import replace

import numpy as np

from estimator.diagnosis.averaged_residual import Averages, averages_of
from estimator.diagnosis.load_resonance import SWING, swing, with_swing
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.processes import Leftover, leftovers
from estimator.diagnosis.thresholds import Thresholds
from estimator.signals import Floats


def remainders(drives: tuple[Drive, ...]) -> tuple[Leftover, ...]:
    """Processes with their evidence summed over all drives, most evidence first."""
    averages = [averages_of(drive.model) for drive in drives]
    each = [{_kind(left): left for left in _all(drive, part)} for drive, part in zip(drives, averages, strict=True)]
    sizes = [len(part) for part in averages]
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
    """The drives with a swinging mass in their models, where ``left`` is one with enough evidence; else unchanged."""
    if not left.name.startswith(SWING) or left.log_bayes_factor < thresholds.min_log_bf_process:
        return drives
    return tuple(replace(drive, model=with_swing(drive.record, drive.model)) for drive in drives)


def _all(drive: Drive, averages: Averages) -> list[Leftover]:
    return [*leftovers(averages), swing(drive.record, drive.model, averages)]


def _kind(left: Leftover) -> str:
    """Name without its period: swinging masses of all periods are one kind."""
    return left.name.partition(" every ")[0]
