"""The file in which a running daemon shows its status, written about once a second."""

import json
import os
import time
from enum import StrEnum
from pathlib import Path
from typing import Any

from estimator.output_files import whole

OLD = 10.0  # s after which a status is no longer that of a living daemon


class State(StrEnum):
    """What the daemon is doing; only a fault needs somebody's attention."""

    WAITING = "waiting for interface"
    LISTENING = "listening"  # open, and nothing heard yet
    SILENT = "ignition off"
    RECEIVING = "receiving"
    FAULT = "fault"


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
