"""What a running daemon shows: one JSON object, written whole about once a second, and the same for Prometheus."""

import json
import os
import time
from dataclasses import asdict
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Any

from estimator import summary
from estimator.daemon.link import Link
from estimator.daemon.transmitter import Transmitter
from estimator.daemon.worker import Knowledge, Worker
from estimator.report.files import whole

OLD = 10.0  # s after which a status is no longer that of a living daemon
PREFIX = "roadload_"


class State(StrEnum):
    """What the daemon is doing; only a fault needs somebody's attention."""

    WAITING = "waiting for interface"
    LISTENING = "listening"  # open, and nothing heard yet
    SILENT = "ignition off"
    RECEIVING = "receiving"
    FAULT = "fault"


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
        "events": dict(transmitter.node.counts),
    }


def write(path: Path, content: dict[str, Any]) -> None:
    """Write a status whole or not at all.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    with whole(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
        temporary.chmod(0o644)


def verdict(content: dict[str, Any], now: float | None = None) -> str:
    """Why a status is not that of a running daemon; empty when it is."""
    pid, written = content.get("pid"), content.get("written_monotonic_s")
    if not isinstance(pid, int) or not isinstance(written, int | float):
        return "not a status file of this version"
    age = (time.monotonic() if now is None else now) - written
    if not is_alive(pid):
        return f"its process {pid} has ended"
    if not 0 <= age <= OLD:
        return f"last heard of {age:.0f} s ago" if age > 0 else "left over from before the last start of the machine"
    return ""


def is_alive(pid: int) -> bool:
    """Whether a process exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


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
            if marginal is not None:
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
