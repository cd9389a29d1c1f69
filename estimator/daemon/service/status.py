"""The parts of a running daemon's status, and the whole for Prometheus."""

import dataclasses
from math import isfinite

import msgspec

from estimator.answers import status as answer
from estimator.answers.status import State, StatusAnswer
from estimator.daemon.reception.link import Link
from estimator.daemon.service.worker import Knowledge, Worker
from estimator.daemon.transmitter import Transmitter
from estimator.estimate import Estimate
from estimator.report import summary

PREFIX = "roadload_"


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


def of_estimate(estimate: Estimate | None, t: float) -> answer.Estimate | None:
    """The latest conclusion as of message time ``t`` [s]."""
    if estimate is None:
        return None
    return answer.Estimate(
        status=estimate.status,
        reason=estimate.reason,
        age_s=round(t - estimate.t, 3),
        samples=estimate.admitted,
        parameters=summary.parameters(estimate),
        convergence=summary.convergence(estimate),
        coverage=summary.coverage(estimate),
    )


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
    """What is sent, and what is withheld."""
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


def metrics(status: StatusAnswer) -> str:
    """The status in Prometheus' text format (version 0.0.4); what is not known is left out."""
    lines: list[str] = []

    def give(name: str, kind: str, *samples: tuple[dict[str, str], float | int | bool | None]) -> None:
        known = [(labels, value) for labels, value in samples if value is not None]
        if known:
            lines.append(f"# TYPE {PREFIX}{name} {kind}")
            lines.extend(f"{PREFIX}{name}{_labels(labels)} {float(value):.17g}" for labels, value in known)

    give("state", "gauge", *(({"state": state.value}, status.state == state) for state in State))
    links = [status.input, *([status.output] if status.output is not None else [])]
    for key in ("frames", "errors", "remote", "malformed", "bus_off", "kernel_drops", "queue_drops", "reopened"):
        give(f"{key}_total", "counter", *(({"bus": link.bus}, getattr(link, key)) for link in links))
    give("frames_per_second", "gauge", ({}, status.frames_per_s))
    give("clock_steps_total", "counter", ({}, status.clock_steps))
    signals = status.signals.items()
    give("signal_age_seconds", "gauge", *(({"signal": role}, x.age_s) for role, x in signals))
    give("readings_total", "counter", *(({"signal": role}, x.readings) for role, x in signals))
    give("refused_total", "counter", *(({"reason": reason}, n) for reason, n in status.refused.items()))
    give("samples_rejected_total", "counter", *(({"reason": r}, n) for r, n in status.samples_rejected.items()))
    give("contested", "gauge", *(({"signal": path, "reason": r}, 1) for path, r in status.contested.items()))
    give("senders_replaced_total", "counter", ({}, status.senders_replaced))
    worker = status.estimator
    give("estimator_queue_drops_total", "counter", ({}, worker.queue_drops))
    give("conclusion_seconds", "gauge", ({}, worker.conclusion_s))
    give("longest_conclusion_seconds", "gauge", ({}, worker.longest_conclusion_s))
    give("state_saves_total", "counter", *(({"result": result}, n) for result, n in worker.state_saves.items()))
    estimate = status.estimate
    if estimate is not None:
        give("estimate_status", "gauge", ({"status": estimate.status.value}, 1))
        give("estimate_age_seconds", "gauge", ({}, estimate.age_s))
        give("coverage_ratio", "gauge", ({}, estimate.coverage.fraction))
        for name, marginal in msgspec.structs.asdict(estimate.parameters).items():
            give(name, "gauge", *(({"moment": key}, getattr(marginal, key)) for key in ("mean", "sd", "q05", "q95")))
    transmit = status.transmit
    if transmit.enabled:
        give("address", "gauge", ({}, transmit.address))
        give("published_total", "counter", ({}, transmit.published))
        give("sending_failed_total", "counter", ({}, transmit.failed))
        give("withheld_total", "counter", *(({"reason": r}, n) for r, n in transmit.withheld.items()))
    return "\n".join(lines) + "\n"


def _labels(labels: dict[str, str]) -> str:
    if not labels:
        return ""

    def escaped(text: str) -> str:
        return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

    return "{" + ",".join(f'{key}="{escaped(value)}"' for key, value in labels.items()) + "}"
