"""The service file under a real systemd: hardened as it is, the daemon starts, hears the bus and says it is ready.

It reads its configuration again on SIGHUP, and is started anew when it hangs.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).parents[2]
UNIT = PROJECT / "tools" / "systemd" / "roadload.service"
SYSTEMD = Path("/lib/systemd/systemd")
LONGEST = 70.0  # s until the daemon is ready; the machine is slow
WATCHDOG = 10  # s, so that the test need not wait for longer
# What is specific to this machine: where Python is, and that nothing else of the system is started. ExecStartPost runs
# when systemd has read READY=1, and not before.
DROP_IN = """
[Unit]
DefaultDependencies=no
[Service]
ProtectHome=tmpfs
BindReadOnlyPaths={paths}
ExecStartPost=/bin/sh -c "echo > /run/roadload/ready"
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


def test_the_daemon_runs_reloads_and_is_guarded_as_the_hardened_service(buses, tmp_path):
    if not SYSTEMD.exists() or shutil.which("unshare") is None:
        pytest.skip("no systemd or unshare here")
    if PROJECT.is_relative_to("/tmp") or PROJECT.is_relative_to("/run"):
        pytest.skip(f"{PROJECT} is in a folder that the service does not see")
    units = tmp_path / "units"
    (units / "roadload.service.d").mkdir(parents=True)
    config = UNIT.with_name("roadload.toml")
    text = UNIT.read_text().replace("/opt/roadload/bin/roadload", f"{sys.executable} -m estimator")
    text = text.replace("/etc/roadload/roadload.toml", str(config)).replace("-c can0", f"-c {buses[0]}")
    (units / UNIT.name).write_text(text)
    paths = f"{sys.base_prefix} {sys.prefix} {PROJECT}"
    (units / "roadload.service.d" / "here.conf").write_text(DROP_IN.format(paths=paths, watchdog=WATCHDOG))
    (units / "test.target").write_text(TARGET)

    script = START.format(units=units, systemd=SYSTEMD)
    own_system = ["unshare", "--pid", "--fork", "--mount", "--mount-proc", "--kill-child", "sh", "-c", script]
    log = tmp_path / "log"
    with (
        log.open("w") as output,
        can.Bus(interface="socketcan", channel=buses[0], ignore_config=True) as player,
        subprocess.Popen(own_system, stdout=output, stderr=output) as systemd,
    ):

        def receiving(condition: Callable[[dict], bool]) -> dict:
            """The status of a daemon that is ready and hears the bus, once it is as wanted."""
            status: dict = {}
            deadline = time.monotonic() + LONGEST
            while status.get("state") != "receiving" or not condition(status):
                assert time.monotonic() < deadline, f"{status}\n{log.read_text()}"
                player.send(can.Message(arbitration_id=0x18FEF100, data=bytes(8)))
                time.sleep(0.2)
                folder = own_folder(systemd.pid)
                if folder is not None and (folder / "ready").exists() and (folder / "status.json").exists():
                    status = json.loads((folder / "status.json").read_text())
            return status

        try:
            first = receiving(lambda status: True)
            os.kill(seen_from_here(first["pid"]), signal.SIGHUP)
            again = receiving(lambda status: status["started_s"] > first["started_s"])
            os.kill(seen_from_here(first["pid"]), signal.SIGSTOP)
            anew = receiving(lambda status: status["pid"] != first["pid"])
        finally:
            systemd.kill()  # unshare heeds nothing milder, and takes systemd with it
    assert again["pid"] == first["pid"]
    assert all(status["input"]["open"] for status in (first, again, anew))


def own_folder(pid: int) -> Path | None:
    """The daemon's folder as systemd, the child of ``pid``, sees it; None before there is a systemd."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return Path(f"/proc/{children[0]}/root/run/roadload") if children else None


def seen_from_here(pid: int) -> int:
    """The process that has this number in the name space of the service."""
    for folder in Path("/proc").glob("[0-9]*"):
        lines = (folder / "status").read_text().splitlines() if (folder / "status").exists() else []
        numbers = next((line.split()[1:] for line in lines if line.startswith("NSpid:")), [])
        if len(numbers) > 1 and int(numbers[-1]) == pid:
            return int(folder.name)
    raise AssertionError(f"there is no process {pid}")
