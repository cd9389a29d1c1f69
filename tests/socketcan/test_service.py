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
# What is specific to this machine: where Python is, and that nothing else of the system is started.
DROP_IN = """
[Unit]
DefaultDependencies=no
[Service]
ProtectHome=tmpfs
BindReadOnlyPaths={paths}
"""
TARGET = "[Unit]\nDefaultDependencies=no\nRequires=roadload.service\n"
START = """
set -e
for folder in /run /tmp /var/lib; do mount -t tmpfs tmpfs $folder; done
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /run/systemd
cp -r {units} /run/systemd/system
exec env -i container=other {systemd} --system --unit=test.target --log-target=console --log-level=info --show-status=false
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
            deadline = time.monotonic() + LONGEST
            # Ready is what systemd says when it has read READY=1; a start that failed never gets there.
            while "Startup finished" not in log.read_text() or status.get("state") != "receiving":
                assert time.monotonic() < deadline, f"{status}\n{log.read_text()}"
                player.send(can.Message(arbitration_id=0x18FEF100, data=bytes(8)))
                status = own_status(systemd.pid)
                time.sleep(0.2)
        finally:
            systemd.kill()  # unshare heeds nothing milder, and takes systemd with it
    assert status["input"]["open"]
    assert "Failed" not in log.read_text()


def own_status(pid: int) -> dict:
    """The status file as systemd, the child of ``pid``, sees it; empty where there is none."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    paths = [Path(f"/proc/{child}/root/run/roadload/status.json") for child in children]
    return next((json.loads(path.read_text()) for path in paths if path.exists()), {})
