"""Fixtures of commands and benchmarks: logging as it was before, scenes that last for seconds."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import pytest

from pipelines.bench.gaps import sources
from pipelines.bench.recordings import simulated_set
from tests.pipelines.drawn_gaps import SHORT


@pytest.fixture(autouse=True)
def _logging_as_it_was() -> Iterator[None]:
    root = logging.getLogger()
    handlers = list(root.handlers)
    yield
    root.handlers = handlers
    for name in ("factors", "saga_fg", "data_tools", "pipelines"):
        logging.getLogger(name).setLevel(logging.NOTSET)


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated scenes of the benchmark that last for seconds."""
    settings = replace(SHORT, duration=7.0)
    monkeypatch.setattr(sources, "_set", lambda name, data, scenes, *_: simulated_set(scenes, settings=settings))
