"""One thread for linear algebra.

The matrices of an estimate have tens of columns. BLAS splits their products among all processors, and the threads then
spend more time on waiting for each other than on computing.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


def start_no_blas_threads() -> None:
    """Keep a BLAS library from starting threads when it is loaded, here and in the processes that this one starts.

    OpenBLAS, which numpy and scipy each bring, starts one a processor, and they wait busily: 0.4 s of processor time in
    each command on two processors. A number that the user has set is kept.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold the BLAS libraries that are loaded to one thread; as a decorator, for the time of a call.

    The limit holds for the whole process. The limits of before come back at the end.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
