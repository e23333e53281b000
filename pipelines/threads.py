"""Threads of the linear algebra library: to matrices as small as a filter's they cost more than they bring."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra on one thread, which also keeps sums in one order."""
    with threadpool_limits(limits=1):
        yield
