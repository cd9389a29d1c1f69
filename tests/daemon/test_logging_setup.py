"""What the journal gets: priorities, whole lines, and no flood."""

import logging
import os
import sys

import pytest

from estimator.daemon.service import logging_setup
from estimator.daemon.service.logging_setup import Once, Prefixed


def record(level: int, message: str, *arguments: object) -> logging.LogRecord:
    return logging.LogRecord("estimator.daemon", level, __file__, 1, message, arguments, None)


def test_every_line_carries_its_priority() -> None:
    form = Prefixed("%(message)s")
    assert form.format(record(logging.WARNING, "%s: gone", "can0")) == "<4>can0: gone"
    assert form.format(record(logging.ERROR, "one\ntwo")) == "<3>one\n<3>two"


def test_what_is_said_over_and_over_is_said_once_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(logging_setup.time, "monotonic", lambda: now)
    once = Once()
    assert once.filter(record(logging.WARNING, "%s: gone", "can0"))
    for _ in range(5):
        assert not once.filter(record(logging.WARNING, "%s: gone", "can0"))
    assert once.filter(record(logging.WARNING, "%s: gone", "can1"))
    assert once.filter(record(logging.ERROR, "%s: gone", "can0"))
    now = 61.0
    later = record(logging.WARNING, "%s: gone", "can0")
    assert once.filter(later)


def test_the_journal_is_known_by_its_stream(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    with open(os.devnull, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert logging_setup.is_journal()
        monkeypatch.setenv("JOURNAL_STREAM", "1:1")
        assert not logging_setup.is_journal()


def test_logging_is_as_before_when_the_daemon_has_ended() -> None:
    logger = logging.getLogger("estimator")
    before = (logger.level, logger.propagate, list(logger.handlers))
    with logging_setup.on_standard_error():
        assert logger.isEnabledFor(logging.INFO)
    assert (logger.level, logger.propagate, list(logger.handlers)) == before
