"""The status of a running daemon: one JSON object, and the same for Prometheus."""

from dataclasses import asdict
from math import isfinite
from typing import Any

from estimator.daemon.reception.link import Link
from estimator.daemon.service.status_file import State
from estimator.daemon.service.worker import Knowledge, Worker
from estimator.daemon.transmitter import Transmitter
from estimator.report import summary

PREFIX = "roadload_"


def of_link(link: Link, now: float) -> dict[str, Any]:
    """State of a bus and counts since the start."""
    silent = now - link.last_frame
    return {
        "bus": link.label,
        "open": link.is_open,
        "up": link.is_up,
        "problem": link.problem,
        "silent_s": round(silent, 3) if isfinite(silent) else None,
        "receive_buffer_bytes": link.buffer_bytes,
        **asdict(link.counts),
        "reopened": link.counts.reopened,
    }


def of_knowledge(knowledge: Knowledge, t: float) -> dict[str, Any]:
    """Signals, samples and the estimate as of message time ``t`` [s]."""
    refused = knowledge.refused
    signals = {
        role: {"readings": count, "age_s": None if newest is None else round(t - newest, 3)}
        for role, count in sorted(knowledge.readings.items())
        for newest in [knowledge.newest.get(role)]
    }
    shown = knowledge.estimate
    estimate = None
    if shown is not None:
        estimate = {
            "status": shown.status.value,
            "reason": shown.reason,
            "age_s": round(t - shown.t, 3),
            "samples": shown.admitted,
            "parameters": summary.parameters(shown),
            "convergence": summary.convergence(shown),
            "coverage": summary.coverage(shown.coverage),
        }
    return {
        "signals": signals,
        "missing": list(knowledge.missing),
        "sources": dict(knowledge.sources),
        "contested": dict(knowledge.contested),
        "senders_replaced": knowledge.replacements,
        "frames_used": knowledge.used,
        "refused": dict(refused),
        "samples_rejected": dict(knowledge.rejected),
        "estimate": estimate,
    }


def of_worker(worker: Worker, now: float) -> dict[str, Any]:
    """How the estimator's thread gets on."""
    return {
        "backlog_frames": worker.backlog,
        "queue_drops": worker.drops,
        "conclusion_s": round(worker.last_conclusion, 4),
        "longest_conclusion_s": round(worker.longest, 4),
        "busy_s": round(worker.stuck_for(now), 3),
        "state_saves": dict(worker.saves),
        "state_problem": worker.save_problem,
        "state_age_s": None if worker.saved_at is None else round(now - worker.saved_at, 1),
    }


def of_transmitter(transmitter: Transmitter | None) -> dict[str, Any]:
    """What goes out, and what is kept back."""
    if transmitter is None:
        return {"enabled": False}
    return {
        "enabled": True,
        "address": transmitter.address,
        "address_lost": transmitter.node.lost,
        "fault": transmitter.node.fault,
        "published": transmitter.published,
        "withheld": dict(transmitter.withheld),
        "failed": transmitter.failed,
        "foreign_weights": transmitter.foreign_weights,
        "colliding_groups": [f"{pgn:04X}" for pgn in transmitter.colliding_groups],
        "events": dict(transmitter.events),
    }


def metrics(content: dict[str, Any]) -> str:
    """The same in Prometheus' text format (version 0.0.4); what is not known is left out."""
    lines: list[str] = []

    def give(name: str, kind: str, *samples: tuple[dict[str, str], float | int | bool | None]) -> None:
        known = [(labels, value) for labels, value in samples if value is not None]
        if known:
            lines.append(f"# TYPE {PREFIX}{name} {kind}")
            lines.extend(f"{PREFIX}{name}{_labels(labels)} {float(value):.17g}" for labels, value in known)

    give("state", "gauge", *(({"state": state.value}, content["state"] == state) for state in State))
    links = [content["input"], *([content["output"]] if content["output"] else [])]
    for key in ("frames", "errors", "remote", "malformed", "bus_off", "kernel_drops", "queue_drops", "reopened"):
        give(f"{key}_total", "counter", *(({"bus": link["bus"]}, link[key]) for link in links))
    give("frames_per_second", "gauge", ({}, content["frames_per_s"]))
    give("clock_steps_total", "counter", ({}, content["clock_steps"]))
    signals = content["signals"].items()
    give("signal_age_seconds", "gauge", *(({"signal": role}, x["age_s"]) for role, x in signals))
    give("readings_total", "counter", *(({"signal": role}, x["readings"]) for role, x in signals))
    give("refused_total", "counter", *(({"reason": reason}, n) for reason, n in content["refused"].items()))
    give("samples_rejected_total", "counter", *(({"reason": r}, n) for r, n in content["samples_rejected"].items()))
    give("contested", "gauge", *(({"signal": path, "reason": r}, 1) for path, r in content["contested"].items()))
    give("senders_replaced_total", "counter", ({}, content["senders_replaced"]))
    worker = content["estimator"]
    give("estimator_queue_drops_total", "counter", ({}, worker["queue_drops"]))
    give("conclusion_seconds", "gauge", ({}, worker["conclusion_s"]))
    give("longest_conclusion_seconds", "gauge", ({}, worker["longest_conclusion_s"]))
    give("state_saves_total", "counter", *(({"result": result}, n) for result, n in worker["state_saves"].items()))
    estimate = content["estimate"]
    if estimate is not None:
        give("estimate_status", "gauge", ({"status": estimate["status"]}, 1))
        give("estimate_age_seconds", "gauge", ({}, estimate["age_s"]))
        give("coverage_ratio", "gauge", ({}, estimate["coverage"]["fraction"]))
        for name, marginal in estimate["parameters"].items():
            if marginal["mean"] is not None:
                give(name, "gauge", *(({"moment": key}, marginal[key]) for key in ("mean", "sd", "q05", "q95")))
    transmit = content["transmit"]
    if transmit["enabled"]:
        give("address", "gauge", ({}, transmit["address"]))
        give("published_total", "counter", ({}, transmit["published"]))
        give("sending_failed_total", "counter", ({}, transmit["failed"]))
        give("withheld_total", "counter", *(({"reason": r}, n) for r, n in transmit["withheld"].items()))
    return "\n".join(lines) + "\n"


def _labels(labels: dict[str, str]) -> str:
    if not labels:
        return ""

    def escaped(text: str) -> str:
        return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

    return "{" + ",".join(f'{key}="{escaped(value)}"' for key, value in labels.items()) + "}"
