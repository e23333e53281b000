"""This process: the threads of its linear algebra, and its memory.

For matrices as small as a filter's, threads cost more than they bring.
"""

from __future__ import annotations

import ctypes
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from threadpoolctl import threadpool_limits

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc
LARGE = 2**18  # bytes


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra on one thread, which also keeps sums in one order."""
    with threadpool_limits(limits=1):
        yield


def return_large_blocks() -> None:
    """Give memory of large blocks back to the system when they are freed.

    Only with glibc as C library, which otherwise keeps ever larger ones (mallopt(3)).
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    for parameter in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD):
        mallopt(parameter, LARGE)


def resident_memory() -> float:
    """Return the resident memory of this process, MB."""
    status = Path("/proc/self/statm")
    if status.exists():
        return int(status.read_text().split()[1]) * resource.getpagesize() / 1e6
    return peak_memory()  # elsewhere


def peak_memory() -> float:
    """Return the largest resident memory that this process has had, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3
