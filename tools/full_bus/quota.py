"""A share of one core for a process, as a cgroup's CPU quota gives it, without the rights that a cgroup needs."""

import os
import signal
import threading
import time
from contextlib import suppress
from types import TracebackType

PERIOD = 0.1  # s in which the share of the time may be used: the kernel's default
LOOK = 0.002  # s between looks at the time that was used


def nanoseconds(pid: int) -> int:
    """Processor time of all threads of a process so far, ended ones too [ns]."""
    return time.clock_gettime_ns((~pid << 3) | 2)  # the clock of a process, as clock_getcpuclockid(3) makes it


class Quota:
    """Stops the process ``pid`` for the rest of a period in which it has used its ``share`` of a core."""

    def __init__(self, pid: int, share: float) -> None:
        self._pid, self._allowed = pid, 1e9 * share * PERIOD
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGCONT)

    def _watch(self) -> None:
        debt = 0.0  # [ns] that were used beyond what was allowed
        with suppress(OSError):  # of a process that has ended
            while not self._ended.is_set():
                end, begin = time.monotonic() + PERIOD, nanoseconds(self._pid)
                while (left := end - time.monotonic()) > 0:
                    is_spent = debt + nanoseconds(self._pid) - begin >= self._allowed
                    os.kill(self._pid, signal.SIGSTOP if is_spent else signal.SIGCONT)
                    time.sleep(min(left, left if is_spent else LOOK))
                debt = max(debt + nanoseconds(self._pid) - begin - self._allowed, 0.0)
