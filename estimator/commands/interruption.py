"""Ctrl-C while logs are read: what is known so far is the answer."""

from collections.abc import Callable

from estimator.commands.complaints import complain
from estimator.report.number_format import clock
from estimator.streaming.replay import Interrupted, Run

EXIT_STATUS = 130  # 128 and the number of SIGINT, as shells have it


def until_interrupted(work: Callable[[], Run]) -> tuple[Run, int]:
    """The result of ``work`` and 0, or what was known at Ctrl-C and the exit status for that, with a note."""
    try:
        return work(), 0
    except Interrupted as stop:
        note_interruption(stop.run)
        return stop.run, EXIT_STATUS


def note_interruption(run: Run) -> None:
    """Say how much of the traffic the answer is from."""
    complain(f"note: interrupted; the answer is that of the first {clock(run.final.t - run.start)} of traffic")
