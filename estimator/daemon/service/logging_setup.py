"""Log lines for the journal: on standard error, with a priority, repeated lines at most once a minute."""

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from estimator.printable import printable

REPEAT_INTERVAL = 60.0  # s within which the same message is not said again
MAX_REMEMBERED = 1000  # messages
PRIORITY = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.DEBUG: 7}  # syslog(3)


class Once(logging.Filter):
    """Suppresses a message logged less than REPEAT_INTERVAL ago; the next one gives the number suppressed."""

    def __init__(self) -> None:
        super().__init__()
        self._said: dict[tuple[str, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to let the record through."""
        now = time.monotonic()
        # The place counts, not the numbers in the message; the first argument is what it is about.
        about = str(record.args[0]) if isinstance(record.args, tuple) and record.args else ""
        key = (str(record.msg), about)
        at, held = self._said.get(key, (-REPEAT_INTERVAL, 0))
        if now - at < REPEAT_INTERVAL and record.levelno < logging.ERROR:
            self._said[key] = (at, held + 1)
            return False
        if len(self._said) >= MAX_REMEMBERED:
            self._said.clear()
        self._said[key] = (now, 0)
        if held:
            record.msg = f"{record.msg} (and {'once' if held == 1 else f'{held} times'} before)"
        return True


class Printable(logging.Formatter):
    """Lines that a terminal can show."""

    def format(self, record: logging.LogRecord) -> str:
        """The lines of a record, with control characters escaped."""
        return "\n".join(map(printable, super().format(record).split("\n")))


class Prefixed(Printable):
    """Lines with the priority in front, as sd-daemon(3) has it."""

    def format(self, record: logging.LogRecord) -> str:
        """One line; a traceback becomes lines of the same priority."""
        prefix = f"<{PRIORITY.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


def is_journal() -> bool:
    """Whether standard error goes to the journal (systemd.exec(5), JOURNAL_STREAM)."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


@contextmanager
def on_standard_error(level: int = logging.INFO) -> Iterator[None]:
    """Log the package's messages to standard error meanwhile."""
    handler = logging.StreamHandler(sys.stderr)
    if is_journal():
        handler.setFormatter(Prefixed("%(message)s"))
    else:
        handler.setFormatter(Printable("%(asctime)s %(levelname)s %(message)s"))
    handler.addFilter(Once())
    logger = logging.getLogger("estimator")
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(level)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]
