"""One thread for linear algebra.

The matrices of an estimate have tens of columns. BLAS splits their products among all processors, and the threads then
spend more time on waiting for each other than on computing.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold the BLAS libraries that are loaded to one thread; as a decorator, for the time of a call.

    The limit holds for the whole process. The limits of before come back at the end.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
