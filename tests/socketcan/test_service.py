"""The service file under a real systemd: hardened as it is, the daemon starts, hears the bus and says it is ready.

It reads its configuration again on SIGHUP, is started anew when it hangs, and keeps up with a full bus.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
from vm.guest import FULL_BUS, send_full_bus

pytestmark = pytest.mark.nightly

PROJECT = Path(__file__).parents[2]
UNIT = PROJECT / "deploy" / "systemd" / "roadload.service"
SYSCTL = UNIT.with_name("60-roadload.conf")
RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
SHOWN = 20  # lines of the daemon's log, when something went wrong
FULL_DURATION = 8.0  # s, in which twice as much is sent as the receive buffer holds
SYSTEMD = Path("/lib/systemd/systemd")
LONGEST = 70.0  # s until the daemon is ready; the machine is slow
WATCHDOG = 10  # s, so that the test need not wait for longer
# What is specific to this machine: where Python and the program are, and that nothing else of the system is started.
# ExecStartPost runs when systemd has read READY=1, and not before.
DROP_IN = """
[Unit]
DefaultDependencies=no
[Service]
ProtectHome=tmpfs
BindReadOnlyPaths={paths}
ExecStartPost=/bin/sh -c "echo > /run/roadload/ready"
Environment=PYTHONPATH={project}
StandardError=append:/run/errors
WatchdogSec={watchdog}
TimeoutAbortSec=1
"""
TARGET = "[Unit]\nDefaultDependencies=no\nRequires=roadload.service\n"
START = """
set -e
for folder in /run /tmp /var/lib; do mount -t tmpfs tmpfs $folder; done
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /run/systemd
cp -r {units} /run/systemd/system
exec env -i container=other {systemd} --system --unit=test.target --log-target=console --show-status=false
"""


Condition = Callable[[dict], bool]


@contextmanager
def service(channel: str, folder: Path) -> Iterator[tuple[Callable[[Condition], dict], can.BusABC]]:
    """The unit under a systemd of its own, on one bus.

    Yields a function that waits until the daemon is ready, hears the bus and has a status as wanted; and a bus to send
    on.
    """
    if not SYSTEMD.exists() or shutil.which("unshare") is None:
        pytest.skip("no systemd or unshare here")
    if PROJECT.is_relative_to("/tmp") or PROJECT.is_relative_to("/run"):
        pytest.skip(f"{PROJECT} is in a folder that the service does not see")
    units = folder / "units"
    (units / "roadload.service.d").mkdir(parents=True)
    config = UNIT.with_name("roadload.toml")
    text = UNIT.read_text().replace("/opt/roadload/bin/roadload", f"{sys.executable} -m estimator")
    text = text.replace("/etc/roadload/roadload.toml", str(config)).replace("-c can0", f"-c {channel}")
    (units / UNIT.name).write_text(text)
    paths = f"{sys.base_prefix} {sys.prefix} {PROJECT}"
    (units / "roadload.service.d" / "here.conf").write_text(
        DROP_IN.format(paths=paths, project=PROJECT, watchdog=WATCHDOG)
    )
    (units / "test.target").write_text(TARGET)

    script = START.format(units=units, systemd=SYSTEMD)
    own_system = ["unshare", "--pid", "--fork", "--mount", "--mount-proc", "--kill-child", "sh", "-c", script]
    log = folder / "log"
    with (
        log.open("w") as output,
        can.Bus(interface="socketcan", channel=channel, ignore_config=True) as player,
        subprocess.Popen(own_system, stdout=output, stderr=output) as systemd,
    ):

        def receiving(condition: Condition) -> dict:
            status: dict = {}
            deadline = time.monotonic() + LONGEST
            while status.get("state") != "receiving" or not condition(status):
                assert time.monotonic() < deadline, f"{status}\n{log.read_text()}\n{errors_of(systemd.pid)}"
                player.send(can.Message(arbitration_id=0x18FEF100, data=bytes(8)))
                time.sleep(0.2)
                here = own_folder(systemd.pid)
                if here is not None and (here / "ready").exists() and (here / "status.json").exists():
                    status = json.loads((here / "status.json").read_text())
            return status

        try:
            yield receiving, player
        finally:
            systemd.kill()  # unshare heeds nothing milder, and takes systemd with it


@pytest.fixture
def shipped_limit() -> Iterator[int]:
    """The largest receive buffer as the shipped sysctl file sets it [bytes]."""
    found = re.search(r"^net\.core\.rmem_max = (\d+)$", SYSCTL.read_text(), re.MULTILINE)
    assert found is not None
    before = RMEM_MAX.read_text()
    RMEM_MAX.write_text(found[1])
    yield int(found[1])
    RMEM_MAX.write_text(before)


def test_the_hardened_service_loses_no_frame_of_a_full_bus_reloads_and_is_guarded(buses, tmp_path, shipped_limit):
    with service(buses[0], tmp_path) as (receiving, player):
        first = receiving(lambda status: True)
        count = send_full_bus(player.socket, FULL_BUS[500], FULL_DURATION)
        full = receiving(lambda status: status["input"]["frames"] >= first["input"]["frames"] + count)
        os.kill(seen_from_here(first["pid"]), signal.SIGHUP)
        again = receiving(lambda status: status["started_s"] > first["started_s"])
        os.kill(seen_from_here(first["pid"]), signal.SIGSTOP)
        anew = receiving(lambda status: status["pid"] != first["pid"])
    assert full["input"]["receive_buffer_bytes"] == 2 * shipped_limit  # without capabilities
    assert (full["input"]["kernel_drops"], full["input"]["queue_drops"]) == (0, 0)
    assert first["pid"] == full["pid"] == again["pid"]
    assert all(status["input"]["open"] for status in (first, full, again, anew))


def own_folder(pid: int) -> Path | None:
    """The daemon's folder as systemd, the child of ``pid``, sees it; None before there is a systemd."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return Path(f"/proc/{children[0]}/root/run/roadload") if children else None


def errors_of(pid: int) -> str:
    """The last lines of what the daemon logged."""
    here = own_folder(pid)
    log = None if here is None else here.with_name("errors")
    return "" if log is None or not log.exists() else "\n".join(log.read_text().splitlines()[-SHOWN:])


def seen_from_here(pid: int) -> int:
    """The process that has this number in the name space of the service."""
    for folder in Path("/proc").glob("[0-9]*"):
        lines = (folder / "status").read_text().splitlines() if (folder / "status").exists() else []
        numbers = next((line.split()[1:] for line in lines if line.startswith("NSpid:")), [])
        if len(numbers) > 1 and int(numbers[-1]) == pid:
            return int(folder.name)
    raise AssertionError(f"there is no process {pid}")
