"""Fixtures of benchmarks: logging as it was before, scenes that last for seconds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.gaps import sources
from benchmarks.recordings import simulated_set
from tests.pipelines.conftest import logging_as_it_was
from tests.pipelines.sampled_gaps import SHORT

__all__ = ["logging_as_it_was"]


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated scenes of the benchmark that last for seconds."""
    settings = replace(SHORT, duration=7.0)
    monkeypatch.setattr(sources, "_set", lambda name, data, scenes, *_: simulated_set(scenes, settings=settings))
