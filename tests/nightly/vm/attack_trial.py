"""Logs played to the installed service, each to a fresh one: what it broadcasts.

Runs in the machine (`tests/nightly/attacks_vm.py` starts it). Beside it are the package, settings, and the logs
``drive*.log``. Of ``drive-1.log`` it writes ``broadcast-1.log`` (candump), ``statuses-1`` (a JSON object a line) and
``played-1.json``.
"""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

from vm.guest import BUS, SETTINGS, STATE, UNIT, make_bus, run, status

LOG = Path("/tmp/drive.log")
OURS = "18FF6000:00FFF800"  # PGN FF60 to FF67
PERIOD = 5.0  # s between two looks at the status
START = 120.0  # s until the service has opened the bus


def main() -> int:
    """Install, play all logs to their ends."""
    make_bus()
    done = run("dpkg", "--install", "old.deb")
    if done.returncode:
        print(done.stdout, done.stderr)
        return 1
    shutil.copy("settings.toml", SETTINGS)
    for log in sorted(Path().glob("drive*.log")):
        restart()
        play(log, log.stem.removeprefix("drive"))
    return 0


def restart() -> None:
    """A service that knows nothing of what was before, and listens on the bus."""
    run("systemctl", "stop", UNIT)
    for kept in STATE.parent.glob(f"{STATE.name}*"):  # the one before, too
        kept.unlink()
    done = run("systemctl", "start", UNIT)
    if done.returncode:
        raise SystemExit(done.stderr)
    deadline = time.monotonic() + START
    while not (content := status()) or not content["input"]["open"]:
        if time.monotonic() > deadline:
            raise SystemExit(f"the service does not listen: {content}")
        time.sleep(1.0)


def play(given: Path, name: str) -> None:
    """Play a log to its end, and write what is heard meanwhile."""
    shutil.copy(given, LOG)
    played = Path(f"played{name}.json")
    with Path(f"broadcast{name}.log").open("w") as heard, Path(f"statuses{name}").open("w", buffering=1) as statuses:
        listener = subprocess.Popen(["stdbuf", "-oL", "candump", "-L", f"{BUS},{OURS}"], stdout=heard)
        began = time.time()
        with LOG.open() as log, subprocess.Popen(["canplayer", f"{BUS}=vcan0"], stdin=log) as player:
            played.write_text(json.dumps({"began_s": began}))
            while player.poll() is None:
                time.sleep(PERIOD)
                statuses.write(json.dumps(status()) + "\n")
        ended = time.time()
        time.sleep(PERIOD)
        listener.terminate()
    played.write_text(json.dumps({"began_s": began, "ended_s": ended}))
    print(f"{given}: played in {ended - began:.0f} s of the machine's clock", flush=True)


if __name__ == "__main__":
    sys.exit(main())
