"""A log played to the installed service: what it broadcasts, and its status every few seconds.

Runs in the machine (`tools/attacks_vm.py` starts it). Beside it are the package, the log, and settings. Writes
``broadcast.log`` (candump), ``statuses`` (a JSON object a line) and ``played.json``.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

from vm.guest import BUS, SETTINGS, UNIT, make_bus, run, shown, status

LOG = Path("/tmp/drive.log")
OURS = "18FF6000:00FFF800"  # PGN FF60 to FF67
PERIOD = 5.0  # s between two looks at the status
START = 120.0  # s until the service has opened the bus


def main() -> int:
    """Install, play the log to its end."""
    make_bus()
    shutil.copy("drive.log", LOG)
    done = run("dpkg", "--install", "old.deb")
    shutil.copy("settings.toml", SETTINGS)
    done = run("systemctl", "start", UNIT) if done.returncode == 0 else done
    if done.returncode:
        print(done.stdout, done.stderr)
        return 1
    wait_until_open()
    arguments = ["candump", "-L", f"{BUS},{OURS}"]
    with Path("broadcast.log").open("w") as heard, Path("statuses").open("w", buffering=1) as statuses:
        listener = subprocess.Popen(["stdbuf", "-oL", *arguments], stdout=heard)
        began = time.time()
        with LOG.open() as log, subprocess.Popen(["canplayer", f"{BUS}=vcan0"], stdin=log) as player:
            Path("played.json").write_text(json.dumps({"began_s": began}))
            while player.poll() is None:
                time.sleep(PERIOD)
                statuses.write(json.dumps(status()) + "\n")
        ended = time.time()
        time.sleep(PERIOD)
        listener.terminate()
    restarts, pid = shown("NRestarts", "MainPID")
    played = {"began_s": began, "ended_s": ended, "restarts": int(restarts), "pid": int(pid), "status": status()}
    Path("played.json").write_text(json.dumps(played))
    print(f"played in {ended - began:.0f} s of the machine's clock", flush=True)
    return 0


def wait_until_open() -> None:
    """Wait until the service listens on the bus."""
    deadline = time.monotonic() + START
    while not (content := status()) or not content["input"]["open"]:
        if time.monotonic() > deadline:
            raise SystemExit(f"the service does not listen: {content}")
        time.sleep(1.0)


if __name__ == "__main__":
    sys.exit(main())
