"""The life of the package in a Debian system under systemd: installed, upgraded, removed, purged.

Runs in the machine (`tests/nightly/package_vm.py` starts it). Beside it are two packages, the
second of a higher version, a drive as a log of candump, and settings. Prints one line a check, and writes all of them
to ``checks.json``.
"""

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vm.guest import BUS, FULL_BUS, SETTINGS, STATE, UNIT, make_bus, run, send_full_bus, shown, status

RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
PROGRAM = Path("/usr/bin/roadload")
USER = "roadload"
FULL_DURATION = 20.0  # s
SETTLED = 5.0  # s after the last frame until it is in the status, which is written every second
LONGEST = 600.0  # s of the machine for anything to happen
ESTIMATE_GROUP = "FF61"  # PGN of the broadcast mass, hexadecimal
# Not the package's: mounted file systems, logs, and the place of systemd and dpkg for what they do at any time.
ELSEWHERE = ("/proc", "/sys", "/dev", "/run", "/share", "/tmp", "/var/tmp", "/var/log")
KEPT_BY_OTHERS = {"/var/lib/private", "/var/lib/dpkg/status-old", "/var/lib/dpkg/triggers/Lock", "/var/lib/dpkg/lock"}

checks: list[dict[str, Any]] = []


def check(what: str, passed: bool, found: object = "") -> None:
    """Note one check with what was found."""
    checks.append({"what": what, "passed": passed, "found": str(found), "uptime_s": round(time.monotonic(), 1)})
    print(f"{'ok  ' if passed else 'FAIL'} {time.monotonic():7.1f} s  {what}: {found}", flush=True)


def files() -> set[str]:
    """All files and folders of the system that a package could own or leave."""
    found = set()
    for folder, below, names in os.walk("/"):
        below[:] = [name for name in below if str(Path(folder, name)) not in ELSEWHERE]
        found |= {str(Path(folder, name)) for name in [*below, *names]}
    return found - KEPT_BY_OTHERS


def known(user: str) -> str:
    """The user as the system's databases show it, empty where there is none."""
    return run("getent", "passwd", user).stdout.strip()


def is_dynamic(uid: int) -> bool:
    """Whether a user id is of those that systemd gives to services while they run."""
    return 61184 <= uid <= 65519


def wait(what: str, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The status, once it is as wanted; ends the trial where that does not happen."""
    deadline = time.monotonic() + LONGEST
    while time.monotonic() < deadline:
        content = status()
        if content and condition(content):
            return content
        time.sleep(0.5)
    check(what, False, f"not within {LONGEST:g} s; {json.dumps(status())}")
    print(run("journalctl", "--no-pager", "--lines=30", "--unit", UNIT).stdout)
    raise SystemExit(1)


def mass(content: dict[str, Any]) -> dict[str, Any] | None:
    """The estimated mass of a status; None while there is none."""
    estimate = content["estimate"]
    found: dict[str, Any] | None = estimate["parameters"]["mass_kg"] if estimate else None
    return found if found and found["status"] == "estimated" else None


def in_words(found: dict[str, Any], content: dict[str, Any]) -> str:
    """An estimated mass, and how much it rests on."""
    return f"{found['mean']:.0f} +- {found['sd']:.0f} kg of {content['estimate']['samples']} samples"


@contextmanager
def heard(path: Path) -> Iterator[Callable[[], list[str]]]:
    """Everything on the bus goes to a file; yields the lines with our mass so far."""
    with path.open("w") as log, subprocess.Popen(["candump", "-L", BUS], stdout=log) as listener:
        try:
            yield lambda: [line for line in path.read_text().splitlines() if f" 18{ESTIMATE_GROUP}" in line]
        finally:
            listener.terminate()


def installed(before: set[str]) -> None:
    """Install; the service is off, files and the buffer's limit are there."""
    old = RMEM_MAX.read_text().strip()
    done = run("dpkg", "--install", "old.deb")
    check("installed by dpkg", done.returncode == 0, (done.stdout + done.stderr).strip().splitlines()[-1])
    enabled = run("systemctl", "is-enabled", UNIT).stdout.strip()
    check("installed disabled", enabled == "disabled" and shown("ActiveState") == ["inactive"], enabled)
    check(
        "receive buffer raised", RMEM_MAX.read_text().strip() == "4194304", f"{old} to {RMEM_MAX.read_text().strip()}"
    )
    check("files", len(files() - before) > 1000, f"{len(files() - before)} new files and folders")


def started(broadcast: Callable[[], list[str]]) -> dict[str, Any]:
    """Enable with settings of the vehicle; it runs as a user of its own, hears the bus, estimates and broadcasts."""
    SETTINGS.write_text(Path("settings.toml").read_text())
    began = time.monotonic()
    done = run("systemctl", "enable", "--now", UNIT)
    check("enabled and started", done.returncode == 0, f"ready after {time.monotonic() - began:.1f} s")
    content = wait("receives", lambda s: s["state"] == "receiving" and s["input"]["frames"] > 100)
    check("hears the bus", True, f"{content['frames_per_s']} frames/s on {content['input']['bus']}")
    (pid,) = shown("MainPID")
    uid = Path(f"/proc/{pid}").stat().st_uid
    capabilities = re.search(r"^CapEff:\s*(\w+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    check("a user of its own", is_dynamic(uid) and USER in known(USER), f"uid {uid}, {known(USER)}")
    check("no capability", capabilities is not None and int(capabilities[1], 16) == 0, capabilities and capabilities[1])
    security = run("systemd-analyze", "--no-pager", "security", UNIT).stdout
    exposure = re.search(r"Overall exposure level.*?([\d.]+) (\w+)", security)
    check("exposure", exposure is not None and float(exposure[1]) <= 2.0, exposure[1] if exposure else security[-200:])
    content = wait("estimated", lambda s: mass(s) is not None and s["estimator"]["state_saves"].get("saved", 0) > 0)
    found = mass(content)
    assert found is not None
    check("estimated and saved", abs(found["mean"] / 27_190 - 1) < 0.1, in_words(found, content))
    wait("broadcast", lambda s: len(broadcast()) > 2)
    check("broadcast", True, broadcast()[-1])
    return content


def upgraded(first: dict[str, Any], broadcast: Callable[[], list[str]]) -> None:
    """A higher version: another process goes on with state and settings, while the vehicle drives."""
    settings, (pid,) = SETTINGS.read_text(), shown("MainPID")
    sent, last = len(broadcast()), status()
    done = run("dpkg", "--install", "new.deb")
    check("upgraded", done.returncode == 0, (done.stdout + done.stderr).strip().splitlines()[-1])
    check("version", True, run("dpkg-query", "--show", "--showformat=${Version}", "roadload").stdout)
    check("settings kept", SETTINGS.read_text() == settings, SETTINGS)
    content = wait("restored", lambda s: str(s["pid"]) != pid and mass(s) is not None)
    found, known = mass(content), mass(last)
    assert found is not None
    assert known is not None
    check("another process", shown("MainPID") != [pid], f"{pid}, then {content['pid']}")
    check("estimate restored", abs(found["mean"] - known["mean"]) < 3 * known["sd"], in_words(found, content))
    kept = content["estimate"]["samples"] >= first["estimate"]["samples"]
    check("samples kept", kept, f"{first['estimate']['samples']} first, {content['estimate']['samples']} now")
    later = wait("continued", lambda s: bool(s["estimate"]) and s["estimate"]["samples"] > last["estimate"]["samples"])
    check("estimate continued", True, in_words(mass(later) or found, later))
    wait("broadcast again", lambda s: len(broadcast()) > sent + 2)
    check("broadcast again", True, broadcast()[-1])
    check(
        "no frame lost", later["input"]["kernel_drops"] + later["input"]["queue_drops"] == 0, later["input"]["frames"]
    )


def loaded() -> None:
    """A full bus and nothing else: the service hears all that was sent."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.bind((BUS,))
        for kbits, rate in FULL_BUS.items():
            before = settled()
            count = send_full_bus(sender, rate, FULL_DURATION)
            after = settled()
            heard, dropped = after["frames"] - before["frames"], after["dropped"] - before["dropped"]
            found = f"{heard:,} of {count:,} frames heard at {rate:,.0f} frames/s, {dropped} counted as dropped"
            check(f"full bus of {kbits} kbit/s", heard == count and not dropped, found)


def settled() -> dict[str, int]:
    """Frames heard and dropped, once everything on the bus is counted."""
    time.sleep(SETTLED)
    content = status()
    bus = content["input"]
    dropped = bus["kernel_drops"] + bus["queue_drops"] + content["estimator"]["queue_drops"]
    return {"frames": bus["frames"], "dropped": dropped}


def removed() -> None:
    """Remove: service and program are gone, state and settings are kept."""
    (pid,) = shown("MainPID")
    done = run("dpkg", "--remove", "roadload")
    check("removed", done.returncode == 0, (done.stdout + done.stderr).strip().splitlines()[-1])
    check("stopped", not Path(f"/proc/{pid}").exists(), pid)
    check("no unit", shown("LoadState") == ["not-found"], shown("LoadState"))
    check("no program", not PROGRAM.exists(), PROGRAM)
    check("state and settings kept", STATE.exists() and SETTINGS.exists(), f"{STATE.stat().st_size} bytes of state")


def purged(before: set[str]) -> None:
    """Purge: nothing is left, and a start of the machine has the limit of the kernel again."""
    done = run("dpkg", "--purge", "roadload")
    check("purged", done.returncode == 0, (done.stdout + done.stderr).strip().splitlines()[-1])
    check("no state, no settings", not STATE.exists() and not SETTINGS.parent.exists())
    check("no user", not known(USER), known(USER))
    after = files()
    check("nothing left", after <= before, sorted(after - before)[:10])
    check("nothing of others taken away", before <= after, sorted(before - after)[:10])
    check("dpkg knows nothing of it", run("dpkg-query", "--status", "roadload").returncode != 0)


def main() -> int:
    """Go through the life of the package; the exit status is 1 if a check failed."""
    make_bus()
    try:
        before = files()
        installed(before)
        with heard(Path("/tmp/heard")) as broadcast, Path("drive.log").open() as log:
            player = subprocess.Popen(["canplayer", f"{BUS}=vcan0"], stdin=log)
            upgraded(started(broadcast), broadcast)
            player.terminate()
        loaded()
        removed()
        purged(before)
    finally:
        Path("checks.json").write_text(json.dumps(checks))
    return int(not all(one["passed"] for one in checks))


if __name__ == "__main__":
    sys.exit(main())
