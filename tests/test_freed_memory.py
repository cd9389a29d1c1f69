"""Whether freed arrays are kept for the next ones."""

import ctypes
import platform
import subprocess
import sys

import pytest

from estimator.freed_memory import keep_freed_memory

FAULTS = """
import resource, sys
import numpy as np
from estimator.freed_memory import keep_freed_memory
keep_freed_memory()
np.ones(2**20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(50):
    np.ones(2**20)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="has rules of its own")
def test_an_array_takes_the_pages_of_the_one_before_even_where_dask_makes_the_library_give_them_back():
    environment = {"MALLOC_TRIM_THRESHOLD_": "65536"}
    done = subprocess.run([sys.executable, "-c", FAULTS], env=environment, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 500  # pages; an array has 2,048


def test_with_another_c_library_nothing_happens(monkeypatch):
    for error in (AttributeError, OSError, TypeError):

        def fails(name, error=error):
            raise error

        monkeypatch.setattr(ctypes, "CDLL", fails)
        keep_freed_memory()
