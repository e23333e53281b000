"""Measurement of time and memory: side by side, in one run, on one thread.

Times are CPU times of the thread, so that whatever else the machine does counts little; contenders take turns frame by
frame, so that what is left of it hits all of them alike. Figures are medians, and ratios of medians.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from saga_fg.kernels.compilation import compiled_kernels


def timed(run: Callable[[], Any]) -> float:
    """Milliseconds of CPU time that a call takes."""
    begin = time.thread_time()
    run()
    return 1e3 * (time.thread_time() - begin)


def size_of(value: Any) -> float:
    """MB of all arrays that a value holds, each counted once."""
    seen: set[int] = set()

    def count(part: Any) -> int:
        if id(part) in seen:
            return 0
        seen.add(id(part))
        if isinstance(part, np.ndarray):
            return 0 if part.base is not None and id(part.base) in seen else part.nbytes
        if isinstance(part, dict):
            return sum(map(count, part.values()))
        if isinstance(part, list | tuple):
            return sum(map(count, part))
        if is_dataclass(part):
            return sum(count(getattr(part, field.name)) for field in fields(part))
        return 0

    return count(value) / 1e6


def environment() -> dict[str, str]:
    """Return versions and hardware that the figures depend on."""
    blas = sorted({f"{pool['internal_api']} {pool['version']}" for pool in threadpool_info()})
    packages = {name: version(name) for name in ("saga-fg", "gtsam", "numpy", "scipy")}
    packages["numba"] = version("numba") if find_spec("numba") is not None else "none"
    machine = {"python": platform.python_version(), "machine": platform.machine(), "blas": ", ".join(blas)}
    return {**machine, **packages, "kernels": "compiled" if compiled_kernels() else "none"}
