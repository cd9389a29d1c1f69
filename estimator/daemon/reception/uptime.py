"""A clock that is never set, and that runs on while the machine is suspended."""

import time


def since_start() -> float:
    """Time [s] since the machine was started, on a clock that is never set.

    Suspensions count: `time.monotonic` leaves them out on Linux, so hours asleep would be taken for a step of the wall
    clock, and the load of before for the present one.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


def asleep() -> float:
    """Time [s] that the machine was suspended since it was started."""
    return since_start() - time.monotonic()
