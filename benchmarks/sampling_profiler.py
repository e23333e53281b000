"""Sampling profiler: the stack of the calling thread, every millisecond, as a file for speedscope.app.

Source of the format: https://www.speedscope.app/file-format-schema.json
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType

from data_tools.files.atomic_files import write_text

PERIOD = 1e-3  # s


class SamplingProfiler:
    """Stacks of calls, the outermost first, and the time, s, that each was found for."""

    def __init__(self) -> None:
        self._codes: dict[CodeType, int] = {}
        self._stacks: list[list[int]] = []
        self._weights: list[float] = []

    @contextmanager
    def running(self) -> Iterator[None]:
        """Sample the thread that enters."""
        thread, done = threading.get_ident(), threading.Event()
        sampler = threading.Thread(target=self._sample, args=(thread, done.wait), daemon=True)
        before = sys.getswitchinterval()
        sys.setswitchinterval(PERIOD / 10)
        sampler.start()
        try:
            yield
        finally:
            done.set()
            sampler.join()
            sys.setswitchinterval(before)

    def _sample(self, thread: int, waited: Callable[[float], bool]) -> None:
        last = time.perf_counter()
        while not waited(PERIOD):
            frame: FrameType | None = sys._current_frames().get(thread)
            stack = []
            while frame is not None:
                stack.append(self._codes.setdefault(frame.f_code, len(self._codes)))
                frame = frame.f_back
            now = time.perf_counter()
            self._stacks.append(stack[::-1])
            self._weights.append(now - last)
            last = now

    def write(self, path: Path, name: str) -> None:
        """Write the profile. Raises `InputError` for a path that is not writable."""
        frames = [
            {"name": code.co_qualname if sys.version_info >= (3, 11) else code.co_name, "file": code.co_filename}
            | {"line": code.co_firstlineno}
            for code in self._codes
        ]
        profile = {
            "type": "sampled",
            "name": name,
            "unit": "seconds",
            "startValue": 0,
            "endValue": sum(self._weights),
            "samples": self._stacks,
            "weights": self._weights,
        }
        schema = "https://www.speedscope.app/file-format-schema.json"
        content = {"$schema": schema, "shared": {"frames": frames}, "profiles": [profile], "name": name}
        write_text(path, json.dumps(content))
