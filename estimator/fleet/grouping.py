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
    for survey in surveys:
        if survey.fault:
            rejected.append(_rejection(survey, "unreadable", survey.fault))
        elif survey.content in seen:
            reason = f"{survey.log.source}: is the same log as {seen[survey.content].log.source}; delete one of them"
            rejected.append(_rejection(survey, "duplicate", reason))
        else:
            seen[survey.content] = survey
            by_vehicle[survey.log.vehicle].append(survey)
    drives = [drive for name in sorted(by_vehicle) for drive in _joined(by_vehicle[name])]
    return Grouped(tuple(drives), tuple(rejected), _notes(drives))


def by_engine(surveys: Sequence[Survey]) -> list[Survey]:
    """Assign each log to the vehicle whose engine claimed an address in it.

    Nodes claim addresses when they start, so files that continue such a log belong to its vehicle. Other logs keep
    their vehicle.
    """
    named: dict[int, Survey] = {}
    last: dict[str, tuple[float, str]] = {}  # end [s] and vehicle of the newest log, by folder
    for i, survey in sorted(enumerate(surveys), key=lambda pair: (pair[1].start, pair[1].log.source)):
        end, last_vehicle = last.get(survey.log.vehicle, (-inf, ""))
        continues = end >= MIN_SET_CLOCK and 0 <= survey.start - end <= JOIN_GAP
        vehicle = survey.engine or (last_vehicle if continues else survey.log.vehicle)
        named[i] = replace(survey, log=replace(survey.log, vehicle=vehicle))
        if not survey.fault:
            last[survey.log.vehicle] = survey.end, vehicle
    return [named[i] for i in range(len(surveys))]


def _rejection(survey: Survey, status: str, reason: str) -> Rejected:
    return Rejected(
        vehicle=survey.log.vehicle,
        source=survey.log.source,
        start=survey.start,
        status=status,
        reason=reason,
    )


def _joined(surveys: list[Survey]) -> list[Drive]:
    """Drives of one vehicle; a file that begins where the previous one ends continues its drive."""
    chains: list[list[Survey]] = []
    for survey in sorted(surveys, key=lambda log: (log.start, log.log.source)):
        last = chains[-1][-1] if chains else None
        continues = last is not None and last.end >= MIN_SET_CLOCK and 0 <= survey.start - last.end <= JOIN_GAP
        chains[-1].append(survey) if continues else chains.append([survey])
    return [
        Drive(
            vehicle=chain[0].log.vehicle,
            sources=tuple(survey.log.source for survey in chain),
            contents=tuple(survey.content for survey in chain),
            start=chain[0].start,
            end=chain[-1].end,
            note=next((survey.note for survey in chain if survey.note), ""),
        )
        for chain in chains
    ]


def _notes(drives: list[Drive]) -> dict[str, str]:
    """Doubts about channels or clocks, by the first source of a drive; a doubt about the clock has precedence."""
    notes = {drive.sources[0]: drive.note for drive in drives if drive.note}
    by_vehicle: dict[str, list[Drive]] = defaultdict(list)
    for drive in drives:
        by_vehicle[drive.vehicle].append(drive)
    for vehicle, vehicle_drives in by_vehicle.items():
        for drive, years in zip(vehicle_drives, years_off([drive.start for drive in vehicle_drives]), strict=True):
            if years is None:
                notes[drive.sources[0]] = "the clock was not set: the times count from its start"
            elif abs(years) > CLOCK_YEARS:
                notes[drive.sources[0]] = f"the clock is {years:+.1f} years from that of most drives of {vehicle}"
    return notes


def years_off(starts: Sequence[float]) -> list[float | None]:
    """Clock error [years] of each drive of a vehicle, begun at ``starts`` [s] (n,), relative to the median drive.

    None if the clock was not set; 0 if at most two clocks were set.
    """
    set_starts = sorted(start for start in starts if start >= MIN_SET_CLOCK)
    middle = set_starts[len(set_starts) // 2] if len(set_starts) > 2 else None
    return [None if start < MIN_SET_CLOCK else 0.0 if middle is None else (start - middle) / YEAR for start in starts]
