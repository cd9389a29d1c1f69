"""A command under limits of time and memory, in a process of its own."""

import io
import multiprocessing
import resource
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from estimator.commands.main import main

CPU_SECONDS, BYTES = 10, 500 << 20
PROCESSES = multiprocessing.get_context("forkserver")  # small processes that have imported the program and pytest
PROCESSES.set_forkserver_preload(["pytest", "estimator.commands.main", "estimator.commands.estimate"])


def exit_status(arguments: list[str], answer: Path) -> int | None:
    """Exit status of a command; ``answer`` gets what it prints."""
    process = PROCESSES.Process(target=_run, args=(arguments, answer))
    process.start()
    process.join()
    return process.exitcode


def _run(arguments: list[str], answer: Path) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as error:
        try:
            status: int | str | None = main(arguments)
        except SystemExit as refusal:  # of argparse
            status = refusal.code
    answer.write_text(out.getvalue() + error.getvalue())
    sys.exit(status)
