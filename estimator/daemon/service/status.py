"""The parts of a running daemon's status."""

import dataclasses
from math import isfinite

from msgspec.structs import replace

from estimator.answers import status as answer
from estimator.answers.published import PublishedAnswer, Usability
from estimator.answers.reference import Reference, References
from estimator.answers.run import RoadNow
from estimator.daemon.reception.link import Link
from estimator.daemon.service.worker import Knowledge, Worker
from estimator.daemon.transmitter import Transmitter
from estimator.estimates import Estimate, Slope, Status
from estimator.report import summary


def of_link(link: Link, now: float) -> answer.Link:
    """State of a bus and counts since the start."""
    silent = now - link.last_frame
    return answer.Link(
        bus=link.label,
        open=link.is_open,
        up=link.is_up,
        problem=link.problem,
        silent_s=round(silent, 3) if isfinite(silent) else None,
        receive_buffer_bytes=link.buffer_bytes,
        **dataclasses.asdict(link.counts),
        reopened=link.counts.reopened,
    )


def of_signals(knowledge: Knowledge, t: float) -> dict[str, answer.Signal]:
    """Readings by role as of message time ``t`` [s]."""
    return {
        role: answer.Signal(readings=count, age_s=None if newest is None else round(t - newest, 3))
        for role, count in sorted(knowledge.readings.items())
        for newest in [knowledge.newest.get(role)]
    }


def published(
    latest: Estimate | None, fresh: Estimate | None, state: answer.State, t: float, written: float, stale_after: float
) -> PublishedAnswer:
    """Answer for other programs at message time ``t`` [s]: values only while the broadcast would have them too.

    Parameters
    ----------
    latest, fresh
        The latest conclusion, and the latest one if the load cannot have changed since, else None.
    written
        Wall time [s].
    stale_after
        Age [s] of a conclusion that is too old.
    """
    status, reason, shown = Usability.UNESTIMATED, "no estimate yet", None
    if fresh is not None and t - fresh.t > stale_after:
        status, reason = Usability.STALE, "the latest conclusion is too old"
    elif fresh is not None:
        is_usable = fresh.status is Status.ESTIMATED
        shown = fresh if is_usable else dataclasses.replace(fresh, mass=None, A=None, C=None)
        status, reason = Usability(fresh.status.value), fresh.reason
    elif latest is not None:
        reason = "the load may have changed since the latest conclusion"
    return PublishedAnswer(
        status=status,
        reason=reason,
        state=state,
        written_s=round(written, 3),
        estimate=summary.conclusion(shown, t, None),
    )


def of_road(slope: Slope | None) -> RoadNow | None:
    """The road under the vehicle, where it is known."""
    return None if slope is None else summary.road_now(slope)


def of_references(knowledge: Knowledge, t: float) -> References:
    """Estimates of other control units, with their age at message time ``t`` [s]."""
    known = knowledge.references
    passed = 0.0 if knowledge.t is None else max(t - knowledge.t, 0.0)
    return References(mass_kg=_aged(known.mass_kg, passed), grade_percent=_aged(known.grade_percent, passed))


def _aged(known: Reference | None, passed: float) -> Reference | None:
    return None if known is None else replace(known, age_s=round(known.age_s + passed, 3))


def of_worker(worker: Worker, now: float) -> answer.Estimator:
    """The estimator's thread."""
    return answer.Estimator(
        backlog_frames=worker.backlog,
        queue_drops=worker.drops,
        conclusion_s=round(worker.last_conclusion, 4),
        longest_conclusion_s=round(worker.longest, 4),
        busy_s=round(worker.stuck_for(now), 3),
        state_saves=dict(worker.saves),
        state_problem=worker.save_problem,
        state_age_s=None if worker.saved_at is None else round(now - worker.saved_at, 1),
    )


def of_transmitter(transmitter: Transmitter | None) -> answer.Transmit:
    """Frames sent, and frames withheld by reason."""
    if transmitter is None:
        return answer.Transmit(enabled=False)
    diagnostics = transmitter.diagnostics
    return answer.Transmit(
        enabled=True,
        address=transmitter.address,
        address_lost=transmitter.node.lost,
        fault=transmitter.node.fault,
        published=transmitter.published,
        withheld={reason.value: count for reason, count in transmitter.withheld.items()},
        failed=transmitter.failed,
        foreign_weights=tuple(transmitter.foreign_weights),
        colliding_groups=tuple(f"{pgn:04X}" for pgn in transmitter.colliding_groups),
        events=dict(transmitter.events),
        trouble_codes=tuple(map(str, diagnostics.memory.active)) if diagnostics is not None else (),
    )
