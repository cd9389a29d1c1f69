"""Programs in the machine: the bus and the service, with the standard library only."""

import json
import socket
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

BUS = "can0"  # of the shipped unit
UNIT = "roadload.service"
SETTINGS = Path("/etc/roadload/roadload.toml")
STATUS = Path("/run/roadload/status.json")
STATE = Path("/var/lib/private/roadload/state")  # of a service with DynamicUser
FULL_BUS = {250: 1908.0, 500: 3817.0}  # frames/s of 8 bytes with 29-bit ids that fill a bus of so many kbit/s
WANTED = 0x18FEF100  # CCVS1, which the filters let pass


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


def send_full_bus(sender: socket.socket, rate: float, duration: float) -> int:
    """Send wanted frames at ``rate`` [frames/s] for ``duration`` [s]; returns their number."""
    frame = struct.pack("=IB3x8s", WANTED | socket.CAN_EFF_FLAG, 8, bytes(8))
    count, began = round(rate * duration), time.monotonic()
    sent = 0
    while sent < count:
        due = min(count, round(rate * (time.monotonic() - began)))
        for _ in range(due - sent):
            sender.send(frame)
        sent = max(sent, due)
        time.sleep(0.002)
    return count
