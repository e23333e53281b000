"""Fixtures of commands: logging as it was before, workers that start at once."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from pipelines.scale_out import pools
from tests.pipelines import forked


@pytest.fixture(autouse=True, scope="session")
def workers_are_forked() -> Iterator[None]:
    """Those of commands in this process: what they import they have already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pools, "multiprocessing", SimpleNamespace(get_context=lambda _: forked.context()))
        yield


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Loggers keep the levels and handlers that they had before a test, and handlers their filters."""
    root = logging.getLogger()
    handlers = {handler: list(handler.filters) for handler in root.handlers}
    yield
    root.handlers = list(handlers)
    for handler, filters in handlers.items():
        handler.filters = filters
    for name in ("factors", "saga_fg", "data_tools", "pipelines"):
        logging.getLogger(name).setLevel(logging.NOTSET)
