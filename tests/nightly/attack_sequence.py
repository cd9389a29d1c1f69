"""Attacks for a bus that cannot be played faster than it is driven: several on one drive, or a short drive each."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from bus_attacks.catalogue import Attack, attacks
from bus_attacks.trial import BIASED_SD, PIECE, Look

from estimator.can_io.frames import Frames
from estimator.simulation.truck import Truck

LEAD = 510.0  # s of driving before the first attack, in which the estimate is made
HELD, SLOT = 40.0, 90.0  # s of an attack, and from one to the next
OWN = 240.0  # s of the drive of an attack that begins with its first frame
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
    was_due: bool  # whether there was an estimate to be withheld, without the attack
    withheld_after: float | None  # from the start of the attack
    back_after: float | None  # from its end
    worst_sd: float | None  # largest deviation from the truth, in posterior standard deviations; None of no estimate

    @property
    def is_wrong(self) -> bool:
        """Whether a wrong parameter was broadcast as estimated."""
        return self.worst_sd is not None and self.worst_sd > BIASED_SD

    @property
    def verdict(self) -> str:
        """Outcome in one or two words, for the table."""
        if self.is_wrong:
            return "silently biased"
        if not self.was_due:
            return "no estimate without it"
        return "unharmed" if self.withheld_after is None else "withheld"


def chosen() -> list[Attack]:
    """Those of the catalogue that begin while there is an estimate, with others between two of one signal.

    A contest that comes again soon lasts longer. The engine's controller changes its address for good, so this is last.
    """
    candidates = [attack for attack in attacks() if attack.shares[0] > 0.0]
    last = [attack for attack in candidates if attack.shares[0] == attack.shares[1]]
    return _in_turn([attack for attack in candidates if attack not in last]) + last


def throughout() -> list[Attack]:
    """Those of the catalogue that begin with the drive, first one of each signal, so that a part of them has all."""
    return _in_turn([attack for attack in attacks() if attack.shares[0] == 0.0])


def _in_turn(candidates: list[Attack]) -> list[Attack]:
    by_signal: dict[str, list[Attack]] = {}
    for attack in candidates:
        by_signal.setdefault(" ".join(attack.name.split()[:2]), []).append(attack)
    queues, order = sorted(by_signal.values(), key=len, reverse=True), []
    while any(queues):
        for queue in sorted(queues, key=len, reverse=True):
            if queue:
                order.append(queue.pop(0))
    return order


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


def on_a_drive(drive: Frames, attack: Attack) -> tuple[Frames, Slot]:
    """The traffic of a drive under one attack that begins with it, and when that is."""
    frames, start, stop = attack.on(drive)
    is_long = attack.shares[1] - attack.shares[0] > MIN_SHARE
    return frames, Slot(name=attack.name, start=start, stop=stop if is_long else start, end=float(drive.t[-1]))


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
    before = [one for one in heard if slot.start - PIECE < one.t <= slot.start]
    during = [one for one in heard if slot.start < one.t < slot.end]
    was_due = any(one.values is not None for one in before)
    return _outcome(during, [one.t for one in during if one.values is None], slot, truck, was_due)


def result_on_a_drive(heard: list[Heard], clean: list[Heard], slot: Slot, truck: Truck) -> Result:
    """What became of an attack that began with the drive; ``clean`` is the same drive without it."""
    due = {one.t for one in clean if one.values is not None}
    during = [one for one in heard if slot.start < one.t < slot.end]
    missing = [one.t for one in during if one.values is None and one.t in due]
    return _outcome(during, missing, slot, truck, bool(due))


def _outcome(during: list[Heard], missing: list[float], slot: Slot, truck: Truck, was_due: bool) -> Result:
    truth = {"mass": truck.mass, "A": truck.A, "C": truck.C}
    known = [(one.t, one.values) for one in during if one.values is not None]
    back = [t for t, _ in known if missing and t > max(slot.stop, missing[0])]
    deviations = [abs(mean - truth[name]) / sd for _, values in known for name, (mean, sd) in values.items()]
    return Result(
        slot=slot,
        was_due=was_due,
        withheld_after=missing[0] - slot.start if missing else None,
        back_after=back[0] - slot.stop if back else None,
        worst_sd=max(deviations) if deviations else None,
    )
