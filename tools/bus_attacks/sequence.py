"""Attacks on one drive, one after the other, for a bus that cannot be played faster than it is driven."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from bus_attacks.catalogue import Attack, attacks
from bus_attacks.trial import BIASED_SD, PIECE, Look
from estimator.can_io.frames import Frames
from estimator.simulation.truck import Truck

LEAD = 510.0  # s of driving before the first attack, in which the estimate is made
HELD, SLOT = 40.0, 90.0  # s of an attack, and from one to the next
MIN_SHARE = 0.01  # of a drive, below which an attack of the catalogue is of one moment
TAIL = 120.0  # s after the last one

Values = dict[str, tuple[float, float]]  # mean and standard deviation of mass [kg], A [N] and C [N s2/m2]


@dataclass(frozen=True)
class Heard:
    """The parameters that were broadcast last at time ``t`` [s], None where they were not available."""

    t: float
    values: Values | None


@dataclass(frozen=True, kw_only=True)
class Slot:
    """One attack of the sequence, from ``start`` to ``stop`` [s]; the next one begins at ``end``."""

    name: str
    start: float
    stop: float
    end: float


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of the broadcast parameters in one slot; times [s] are None where that did not happen."""

    slot: Slot
    known_before: bool
    withheld_after: float | None  # from the start of the attack
    back_after: float | None  # from its end
    worst_sd: float  # largest deviation from the truth, in posterior standard deviations

    @property
    def verdict(self) -> str:
        """Outcome in one or two words, for the table."""
        if not self.known_before:
            return "no estimate before it"
        if self.worst_sd > BIASED_SD:
            return "silently biased"
        return "unharmed" if self.withheld_after is None else "withheld"


def chosen() -> list[Attack]:
    """Those of the catalogue that begin while there is an estimate, with others between two of one signal.

    A contest that comes again soon lasts longer. The engine's controller changes its address for good, so this is last.
    """
    candidates = [attack for attack in attacks() if attack.shares[0] > 0.0]
    last = [attack for attack in candidates if attack.shares[0] == attack.shares[1]]
    by_signal: dict[str, list[Attack]] = {}
    for attack in candidates:
        if attack not in last:
            by_signal.setdefault(" ".join(attack.name.split()[:2]), []).append(attack)
    queues, order = sorted(by_signal.values(), key=len, reverse=True), []
    while any(queues):
        for queue in sorted(queues, key=len, reverse=True):
            if queue:
                order.append(queue.pop(0))
    return order + last


def duration(count: int) -> float:
    """How long [s] a drive with ``count`` attacks lasts."""
    return LEAD + SLOT * count + TAIL


def in_sequence(drive: Frames, order: Iterable[Attack]) -> tuple[Frames, list[Slot]]:
    """The traffic with one attack after the other, and when they are."""
    frames, slots, order = drive, [], list(order)
    for k, attack in enumerate(order):
        start = float(drive.t[0]) + LEAD + SLOT * k
        end = start + SLOT + (TAIL if k == len(order) - 1 else 0.0)
        stop = start + (HELD if attack.shares[1] - attack.shares[0] > MIN_SHARE else 0.0)
        slots.append(Slot(name=attack.name, start=start, stop=stop, end=end))
        frames = attack.apply(frames, start, stop)
    return frames, slots


def of_looks(looks: list[Look]) -> list[Heard]:
    """What is broadcast in process."""
    heard = []
    for look in looks:
        estimate, values = look.estimate, None
        if look.is_estimated and estimate:
            marginals = {"mass": estimate.mass, "A": estimate.A, "C": estimate.C}
            values = {name: (one.mean, one.sd) for name, one in marginals.items() if one is not None}
        heard.append(Heard(look.t, values))
    return heard


def looked_up(at: Callable[[float], Values | None], first: float, last: float) -> list[Heard]:
    """What was broadcast last at all multiples of PIECE from ``first`` to ``last`` [s]."""
    edges = PIECE * np.arange(np.ceil(first / PIECE), np.floor(last / PIECE) + 1)
    return [Heard(edge, at(edge)) for edge in edges.tolist()]


def results(heard: list[Heard], slots: list[Slot], truck: Truck) -> list[Result]:
    """What became of every attack that was heard to its end."""
    return [_result(heard, slot, truck) for slot in slots if heard[-1].t >= slot.end - 2 * PIECE]


def _result(heard: list[Heard], slot: Slot, truck: Truck) -> Result:
    truth = {"mass": truck.mass, "A": truck.A, "C": truck.C}
    before = [one for one in heard if slot.start - PIECE < one.t <= slot.start]
    during = [one for one in heard if slot.start < one.t < slot.end]
    missing = [one.t for one in during if one.values is None]
    back = [one.t for one in during if one.values is not None and one.t > slot.stop and missing]
    return Result(
        slot=slot,
        known_before=any(one.values is not None for one in before),
        withheld_after=missing[0] - slot.start if missing else None,
        back_after=back[0] - slot.stop if back else None,
        worst_sd=max(
            (
                abs(mean - truth[name]) / sd
                for one in during
                if one.values is not None
                for name, (mean, sd) in one.values.items()
            ),
            default=0.0,
        ),
    )
