"""One attack on one drive: the broadcast parameters during and after it, and their errors."""

from dataclasses import dataclass
from math import ceil

import numpy as np

from bus_attacks.catalogue import Attack
from estimator.can_io.frames import Frames
from estimator.config import Config
from estimator.estimates import Estimate, Status
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

PIECE = 5.0  # s of traffic between two looks at the estimate
BIASED_SD = 4.0  # posterior standard deviations off the truth that count as biased


@dataclass(frozen=True)
class Look:
    """The parameters broadcast at time ``t`` [s]."""

    t: float
    estimate: Estimate | None
    contested: dict[str, str]

    @property
    def is_estimated(self) -> bool:
        """Whether there are values."""
        return self.estimate is not None and self.estimate.status == Status.ESTIMATED


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Times [s] at which the estimate was withheld and came back, None where it was not, and its largest errors."""

    looks: int  # with an estimate, from the start of the attack on
    withheld_after_s: float | None  # from the start of the attack
    back_after_s: float | None  # from its end, until there is an estimate again
    worst_sd: float | None  # largest deviation from the truth of mass, A and C, in posterior standard deviations
    worst_share_of_mass: float | None  # largest of the mass, as a share of the truth
    contested_for: list[str]

    @property
    def verdict(self) -> str:
        """Outcome in one or two words, for the table."""
        if (self.worst_sd or 0.0) > BIASED_SD:
            return "silently biased"
        return "unharmed" if self.withheld_after_s is None else "withheld"


def look_at(frames: Frames, config: Config) -> list[Look]:
    """The broadcast parameters at all multiples of PIECE."""
    pipeline, seen = Pipeline(config), []
    edges = PIECE * np.arange(ceil(float(frames.t[0]) / PIECE), ceil(float(frames.t[-1]) / PIECE) + 1)
    bounds = [0, *np.searchsorted(frames.t, edges).tolist()]
    for edge, low, high in zip(edges.tolist(), bounds[:-1], bounds[1:], strict=True):
        for _ in pipeline.feed(frames[low:high]):
            pass
        seen.append(Look(edge, pipeline.latest, pipeline.traffic.contested))
    return seen


def deviations(looks: list[Look], truck: Truck) -> list[float]:
    """Errors of mass, A and C of every estimate, in posterior standard deviations."""
    pairs = [
        (marginal, truth)
        for look in looks
        if look.is_estimated and (e := look.estimate)
        for marginal, truth in ((e.mass, truck.mass), (e.A, truck.A), (e.C, truck.C))
    ]
    return [abs(marginal.mean - truth) / marginal.sd for marginal, truth in pairs if marginal is not None]


def attempt(attack: Attack, drive: Frames, clean: list[Look], truck: Truck, config: Config) -> Outcome:
    """Attack the drive of a known truck; ``clean`` are the broadcast parameters without the attack."""
    frames, start, stop = attack.on(drive)
    after = [look for look in look_at(frames, config) if look.t > start]
    known = [look.estimate.mass for look in after if look.is_estimated and look.estimate and look.estimate.mass]
    there = {look.t for look in after if look.is_estimated}
    missing = [look.t for look in clean if look.is_estimated and look.t > start and look.t not in there]
    back = [t for t in sorted(there) if t > stop and missing and t > missing[0]]
    return Outcome(
        looks=len(known),
        withheld_after_s=missing[0] - start if missing else None,
        back_after_s=back[0] - stop if back else None,
        worst_sd=max(deviations(after, truck), default=None),
        worst_share_of_mass=max((abs(m.mean / truck.mass - 1) for m in known), default=None),
        contested_for=sorted({reason for look in after for reason in look.contested.values()}),
    )
