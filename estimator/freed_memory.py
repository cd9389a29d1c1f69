"""Freed memory is kept for the next array, and not given back to the kernel.

The arrays of a fit have megabytes and live for milliseconds. By its own rules the GNU C library gives such memory back,
and the kernel clears every page of it that is asked for again. Dask starts its workers with rules that give back more.
"""

import ctypes

# Parameters of mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
LARGEST_ARRAY = 32 * 2**20  # bytes: larger ones are given back; the most that the library takes
KEPT = 64 * 2**20  # bytes at the end of the heap


def keep_freed_memory() -> None:
    """Keep up to KEPT bytes that are free, for the rest of this process; nothing happens with another C library."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    mallopt(_MMAP_THRESHOLD, LARGEST_ARRAY)
    mallopt(_TRIM_THRESHOLD, KEPT)
