"""Which start of the machine this is: a clock tells time away only as long as the machine has not been off.

A gateway without a battery for its clock goes on from the time at which it was switched off, as if no time had passed.
"""

from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # random(4): made anew at every start of the kernel


def boot_id() -> str:
    """A name of this start; empty where the kernel does not tell, for then no two are known to be the same."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""
