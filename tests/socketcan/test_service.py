"""The service file under a real systemd: hardened as it is, the daemon starts, hears the bus and says it is ready."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

PROJECT = Path(__file__).parents[2]
UNIT = PROJECT / "tools" / "systemd" / "roadload.service"
SYSTEMD = Path("/lib/systemd/systemd")
LONGEST = 70.0  # s until the daemon is ready; the machine is slow
# What is specific to this machine: where Python is, and that nothing else of the system is started. ExecStartPost runs
# when systemd has read READY=1, and not before.
DROP_IN = """
[Unit]
DefaultDependencies=no
[Service]
ProtectHome=tmpfs
BindReadOnlyPaths={paths}
ExecStartPost=/bin/sh -c "echo > /run/roadload/ready"
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


def test_the_daemon_runs_as_the_hardened_service(buses, tmp_path):
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
    (units / "roadload.service.d" / "here.conf").write_text(DROP_IN.format(paths=paths))
    (units / "test.target").write_text(TARGET)

    script = START.format(units=units, systemd=SYSTEMD)
    own_system = ["unshare", "--pid", "--fork", "--mount", "--mount-proc", "--kill-child", "sh", "-c", script]
    log = tmp_path / "log"
    with (
        log.open("w") as output,
        can.Bus(interface="socketcan", channel=buses[0], ignore_config=True) as player,
        subprocess.Popen(own_system, stdout=output, stderr=output) as systemd,
    ):
        try:
            status: dict = {}
            ready = False
            deadline = time.monotonic() + LONGEST
            while not ready or status.get("state") != "receiving":
                assert time.monotonic() < deadline, f"ready: {ready}, {status}\n{log.read_text()}"
                player.send(can.Message(arbitration_id=0x18FEF100, data=bytes(8)))
                time.sleep(0.2)
                if (folder := own_folder(systemd.pid)) is not None:
                    ready = (folder / "ready").exists()
                    shown = folder / "status.json"
                    status = json.loads(shown.read_text()) if shown.exists() else {}
        finally:
            systemd.kill()  # unshare heeds nothing milder, and takes systemd with it
    assert status["input"]["open"]


def own_folder(pid: int) -> Path | None:
    """The daemon's folder as systemd, the child of ``pid``, sees it; None before there is a systemd."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return Path(f"/proc/{children[0]}/root/run/roadload") if children else None
