"""Grouping of logs to drives: files that continue each other are one drive, and a duplicate log is not used."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from math import inf

from estimator.fleet.survey import Survey
from estimator.streaming.row_stream import MIN_SET_CLOCK

JOIN_GAP = 10.0  # s between two files, up to which the second continues the first
OVERLAP = 10.0  # s by which drives of one vehicle must overlap to be doubted
YEAR = 365.25 * 86400.0  # s
CLOCK_YEARS = 2.0  # between the drives of a vehicle, beyond which one of the clocks is doubted


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Files of one drive in order, hashes of their contents, and times [s] of its first and last frame."""

    vehicle: str
    sources: tuple[str, ...]
    contents: tuple[str, ...]
    start: float
    end: float
    note: str = ""  # a doubt about its logs


@dataclass(frozen=True, kw_only=True)
class Rejected:
    """Log that gives no drive; ``status`` is "unreadable" or "duplicate"."""

    vehicle: str
    source: str
    start: float
    status: str
    reason: str


@dataclass(frozen=True)
class Grouped:
    """Drives in order of vehicle and time, rejected logs, and notes on drives by their first source."""

    drives: tuple[Drive, ...]
    rejected: tuple[Rejected, ...]
    notes: dict[str, str] = field(default_factory=dict)

    @cached_property
    def _spans(self) -> dict[str, list[tuple[float, float]]]:
        """Start and end [s] of the drives whose clock was set, in order, by vehicle."""
        spans: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for start, end, vehicle in sorted((d.start, d.end, d.vehicle) for d in self.drives):
            if start >= MIN_SET_CLOCK:
                spans[vehicle].append((start, end))
        return spans

    def overlapping(self, vehicle: str) -> int:
        """Number of drives of a vehicle that begin over OVERLAP before another one ends."""
        spans = self._spans[vehicle]
        ended = accumulate((end for _, end in spans), max)  # the latest so far
        return sum(start < end - OVERLAP for end, (start, _) in zip(ended, spans[1:], strict=False))


def group(surveys: Sequence[Survey]) -> Grouped:
    """Group the logs of a fleet to drives."""
    rejected: list[Rejected] = []
    by_vehicle: dict[str, list[Survey]] = defaultdict(list)
    seen: dict[str, Survey] = {}
    for one in surveys:
        if one.fault:
            rejected.append(_rejection(one, "unreadable", one.fault))
        elif one.content in seen:
            reason = f"{one.log.source}: is the same log as {seen[one.content].log.source}; delete one of them"
            rejected.append(_rejection(one, "duplicate", reason))
        else:
            seen[one.content] = one
            by_vehicle[one.log.vehicle].append(one)
    drives = [drive for name in sorted(by_vehicle) for drive in _joined(by_vehicle[name])]
    return Grouped(tuple(drives), tuple(rejected), _notes(drives))


def by_engine(surveys: Sequence[Survey]) -> list[Survey]:
    """Assign each log to the vehicle whose engine claimed an address in it.

    Nodes claim addresses when they start, so files that continue such a log belong to its vehicle. Other logs keep
    their vehicle.
    """
    named: dict[int, Survey] = {}
    last: dict[str, tuple[float, str]] = {}  # end [s] and vehicle of the newest log, by folder
    for i, one in sorted(enumerate(surveys), key=lambda pair: (pair[1].start, pair[1].log.source)):
        end, before = last.get(one.log.vehicle, (-inf, ""))
        continues = end >= MIN_SET_CLOCK and 0 <= one.start - end <= JOIN_GAP
        vehicle = one.engine or (before if continues else one.log.vehicle)
        named[i] = replace(one, log=replace(one.log, vehicle=vehicle))
        if not one.fault:
            last[one.log.vehicle] = one.end, vehicle
    return [named[i] for i in range(len(surveys))]


def _rejection(one: Survey, status: str, reason: str) -> Rejected:
    return Rejected(vehicle=one.log.vehicle, source=one.log.source, start=one.start, status=status, reason=reason)


def _joined(surveys: list[Survey]) -> list[Drive]:
    """Drives of one vehicle; a file that begins where the previous one ends continues its drive."""
    chains: list[list[Survey]] = []
    for one in sorted(surveys, key=lambda each: (each.start, each.log.source)):
        last = chains[-1][-1] if chains else None
        continues = last is not None and last.end >= MIN_SET_CLOCK and 0 <= one.start - last.end <= JOIN_GAP
        chains[-1].append(one) if continues else chains.append([one])
    return [
        Drive(
            vehicle=chain[0].log.vehicle,
            sources=tuple(one.log.source for one in chain),
            contents=tuple(one.content for one in chain),
            start=chain[0].start,
            end=chain[-1].end,
            note=next((one.note for one in chain if one.note), ""),
        )
        for chain in chains
    ]


def _notes(drives: list[Drive]) -> dict[str, str]:
    """Doubts about channels or clocks, by the first source of a drive; a doubt about the clock has precedence."""
    notes = {drive.sources[0]: drive.note for drive in drives if drive.note}
    by_vehicle: dict[str, list[Drive]] = defaultdict(list)
    for drive in drives:
        by_vehicle[drive.vehicle].append(drive)
    for vehicle, own in by_vehicle.items():
        for drive, years in zip(own, years_off([drive.start for drive in own]), strict=True):
            if years is None:
                notes[drive.sources[0]] = "the clock was not set: the times count from its start"
            elif abs(years) > CLOCK_YEARS:
                notes[drive.sources[0]] = f"the clock is {years:+.1f} years from that of most drives of {vehicle}"
    return notes


def years_off(starts: Sequence[float]) -> list[float | None]:
    """Clock error [years] of each drive of a vehicle, begun at ``starts`` [s] (n,), relative to the median drive.

    None if the clock was not set; 0 if at most two clocks were set.
    """
    known = sorted(start for start in starts if start >= MIN_SET_CLOCK)
    middle = known[len(known) // 2] if len(known) > 2 else None
    return [None if start < MIN_SET_CLOCK else 0.0 if middle is None else (start - middle) / YEAR for start in starts]
