"""Run a command on a kernel with SocketCAN, for hosts without it: a stock Debian kernel in QEMU.

    python tools/vcan_vm.py [--share FOLDER] [--timeout SECONDS] -- COMMAND...

The command can read the host's files, and can write to FOLDER only; ``ip link add type vcan``, can-utils and the
project's Python work in it. The exit status is the command's.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from vm.debian import VmError
from vm.machine import run, shown_console


def main() -> int:
    """Boot, run the command, print the console output."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=Path, help="folder to write to (default: a temporary one)")
    parser.add_argument("--timeout", type=float, default=600.0, help="s, default 600")
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        share = options.share or Path(scratch)
        try:
            with shown_console(share):
                return run(options.command, share, timeout=options.timeout)
        except VmError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1


if __name__ == "__main__":
    sys.exit(main())
