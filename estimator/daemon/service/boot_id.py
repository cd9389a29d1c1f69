"""Identity of the machine's start: clocks measure a downtime only if the machine was not switched off in it.

A gateway without a battery for its clock continues from the time at which it was switched off.
"""

from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # random(4): made anew at every start of the kernel


def boot_id() -> str:
    """Identifier of this start; empty where the kernel has none, and two starts are then never equal."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""
