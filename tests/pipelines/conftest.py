"""Fixtures of commands: logging as it was before."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest


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
