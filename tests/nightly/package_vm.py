"""The Debian package in a virtual machine with systemd: python tests/nightly/package_vm.py [--packages FOLDER].

Builds the package and one of a higher version, boots a small Debian system with systemd as its first process, and
installs, runs, upgrades, removes and purges the package there, on a virtual CAN bus on which a simulated truck drives.
The checks are in tests/nightly/vm/package_trial.py; exit status 1 if one fails. Needs qemu-system-x86_64 and, as root,
apt; about twelve minutes of two busy cores, so it is no part of the tests.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from vm.debian import VmError, system
from vm.machine import EARLY_GATE, QUICK_SAMPLER, require_qemu, run, shown_console

from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.demo import TRUCK
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route

DURATION, SEED = 900.0, 3  # s of driving; with this one there is an estimate after 210 s
PROGRAMS = Path(__file__).parent / "vm"
BUILD = Path(__file__).parents[2] / "deploy" / "build_deb.py"
LONGEST = 5400.0  # s of the host
SETTINGS = f"""
{QUICK_SAMPLER}
{EARLY_GATE}
[transmit]
enabled = true
[service]
save_interval_s = 10.0
"""


def main() -> int:
    """Build, boot, print the checks, return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", type=Path, help="the package, where it has been built (deploy/build_deb.py)")
    options = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        share = Path(scratch)
        try:
            require_qemu()
            debian = system()
            prepare(share, options.package)
            with shown_console(share):
                code = run(["python3", "-m", "vm.package_trial"], share, timeout=LONGEST, system=debian)
        except VmError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        checks = json.loads((share / "checks.json").read_text())
    passed = sum(one["passed"] for one in checks)
    print(f"{passed} of {len(checks)} checks passed; {checks[-1]['uptime_s']:.0f} s of the machine's clock", end=", ")
    print(f"{time.monotonic() - began:.0f} s of this one")
    return code


def prepare(share: Path, package: Path | None) -> None:
    """What the trial needs: both packages, the drive, the settings and the program of the trial."""
    share_package(share, package)
    successor(share / "old.deb", share / "new.deb")
    rng = np.random.default_rng(SEED)
    frames = frames_of(record(TRUCK, generate_route("mixed", 30e3, rng), DURATION, rng).signals)
    write_log(frames, share / "drive.log")
    (share / "settings.toml").write_text(SETTINGS)


def share_package(share: Path, package: Path | None) -> None:
    """Put the package, built where there is none, and the programs of the machine into the shared folder."""
    if package is None:
        build = [sys.executable, str(BUILD), "--output", str(share), "--compression", "none"]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        (package,) = share.glob("*.deb")
    shutil.copyfile(package, share / "old.deb")
    shutil.copytree(PROGRAMS, share / PROGRAMS.name, ignore=shutil.ignore_patterns("__pycache__"))


def successor(package: Path, path: Path) -> None:
    """The same package with a higher version."""
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        tree = Path(scratch) / "tree"
        subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(tree)], check=True)
        control = tree / "DEBIAN" / "control"
        control.write_text(re.sub(r"^(Version: .*)$", r"\1+1", control.read_text(), flags=re.MULTILINE))
        build = ["dpkg-deb", "--root-owner-group", "-Znone", "--build", str(tree), str(path)]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
