"""Execution of the tasks of a fleet, in this process or on Dask's workers."""

import logging
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import Any, Protocol, TypeVar

from estimator.errors import RoadloadError
from estimator.extras import how_to_install

Item = TypeVar("Item")
Result = TypeVar("Result")
SECONDS_TO_CONNECT = 30
SECONDS_TO_START = 120  # until a first task is done: a cluster may start its workers when there is a task
GONE = "the scheduler has gone away; run again: the drives that are done are kept"
DEATHS = 1  # of workers that a task may survive: a log that takes all memory does so again


@dataclass(frozen=True)
class Failure:
    """Task without a result, and the reason: an error in the program, or a lost worker."""

    reason: str
    worker_died: bool = False


class Engine(Protocol):
    """Interface that runs one function on many items."""

    def map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Failure]]:
        """Yield the index and the result of each item, in the order of completion."""
        ...


class Serial:
    """Runs items in this process, one by one."""

    def map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Failure]]:
        """Yield the index and the result of each item; see `Engine.map`."""
        for i, item in enumerate(items):
            try:
                result: Result | Failure = work(item)
            except Exception as error:  # one item fails, with the reason
                result = _failure(error)
            yield i, result


class Distributed:
    """Runs items on the workers of a Dask cluster."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result | Failure]]:
        """Yield the index and the result of each item; see `Engine.map`.

        Raises
        ------
        RoadloadError
            The scheduler has gone away.
        """
        from distributed import as_completed
        from distributed.client import FutureCancelledError
        from distributed.comm import CommClosedError

        try:
            waiting = {self._client.submit(work, item, pure=False): i for i, item in enumerate(items)}
            suspects = []
            for future in as_completed(list(waiting), loop=self._client.loop):
                i, answer = waiting.pop(future), self._answer(future)
                if isinstance(answer, Failure) and answer.worker_died:
                    suspects.append(i)  # or another task on that worker is the cause
                else:
                    yield i, answer
            for i in suspects:  # alone
                yield i, self._answer(self._client.submit(work, items[i], pure=False))
        except (FutureCancelledError, CommClosedError):  # at any of these calls
            raise RoadloadError(GONE) from None

    def _answer(self, future: Any) -> Any:
        """Wait for a task, and return its result or failure."""
        from distributed import KilledWorker

        try:
            error = future.exception()
            if self._client.status != "running":
                raise RoadloadError(GONE)
            if error is None:
                return future.result()
        except KilledWorker as died:  # with a result that was not fetched yet: the task was run again
            error = died
        if not isinstance(error, KilledWorker):
            return _failure(error)
        reason = f"{DEATHS + 1} workers died of it, as one does that has too little memory"
        return Failure(reason, worker_died=True)


def _failure(error: BaseException) -> Failure:
    return Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")


@contextmanager
def dask_engine(scheduler: str | None, workers: int | None) -> Iterator[Engine]:
    """Yield an engine of the workers of the cluster at the address ``scheduler``, or of local processes without one.

    Where ``workers`` is None there are as many of them as this process has processors.

    Raises
    ------
    RoadloadError
        Dask is not installed, no scheduler answers at the address, or it has no workers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.utils import silence_logging_cmgr
    except ImportError as error:
        raise RoadloadError(f"roadload fleet needs Dask: {how_to_install('fleet')}") from error
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=SECONDS_TO_CONNECT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise RoadloadError(f"{scheduler}: no Dask scheduler answers there; check --scheduler") from error
        with silence_logging_cmgr(logging.CRITICAL), client:  # else a scheduler that goes away is a traceback
            _await_worker(client, scheduler)
            yield Distributed(client)
        return
    options: dict[str, Any] = {"threads_per_worker": 1, "processes": True, "silence_logs": logging.CRITICAL}
    options["dashboard_address"] = "127.0.0.1:0"  # any port that is free
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.worker.profile.enabled": False,  # keeps what a worker did in each of the last 3,600 s: 0.3 MiB/s
    }
    with dask.config.set(settings), ExitStack() as stack:
        with _no_interrupts():
            cluster = stack.enter_context(LocalCluster(n_workers=workers, **options))
        yield Distributed(stack.enter_context(Client(cluster, set_as_default=False)))


def _await_worker(client: Any, scheduler: str) -> None:
    try:
        client.submit(int, pure=False).result(timeout=SECONDS_TO_START)
    except TimeoutError as error:
        reason = f"{scheduler}: no worker took a task within {SECONDS_TO_START} s; start one: dask worker {scheduler}"
        raise RoadloadError(reason) from error


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Block Ctrl-C for all threads and processes that are started within the context.

    Ctrl-C goes to all processes, and each worker would write a traceback. This process ends the workers instead.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows: their tracebacks come before the line of this process
        yield
        return
    resource_tracker.ensure_running()  # once; its start would undo what follows for the thread that starts workers
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
