"""Programs in the machine: the bus and the service, with the standard library only."""

import json
import subprocess
from pathlib import Path
from typing import Any

BUS = "can0"  # of the shipped unit
UNIT = "roadload.service"
SETTINGS = Path("/etc/roadload/roadload.toml")
STATUS = Path("/run/roadload/status.json")


def make_bus() -> None:
    """A virtual CAN interface that is up."""
    for arguments in (("add", "dev", BUS, "type", "vcan"), ("set", "dev", BUS, "up")):
        subprocess.run(["ip", "link", *arguments], check=True)


def run(*command: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(command, capture_output=True, text=True)


def shown(*properties: str) -> list[str]:
    """Properties of the unit, as systemd says."""
    lines = run("systemctl", "show", UNIT, *(f"--property={name}" for name in properties)).stdout.splitlines()
    found = dict(line.split("=", 1) for line in lines)
    return [found.get(name, "") for name in properties]


def status() -> dict[str, Any]:
    """The status of the running daemon, empty where there is none."""
    try:
        content: dict[str, Any] = json.loads(STATUS.read_text())
    except (OSError, json.JSONDecodeError):
        return {}
    return content
