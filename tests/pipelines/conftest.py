"""The command sets up logging for its process; tests that run it in theirs put things back."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def _logging_as_it_was() -> Iterator[None]:
    root = logging.getLogger()
    handlers = list(root.handlers)
    yield
    root.handlers = handlers
    for name in ("factors", "saga_fg", "data_tools", "pipelines"):
        logging.getLogger(name).setLevel(logging.NOTSET)
