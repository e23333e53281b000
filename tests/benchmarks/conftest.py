"""Fixtures of benchmarks: a run of the command, and what the command sets up put back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.app import app
from tests.pipelines.conftest import logging_as_it_was

__all__ = ["logging_as_it_was"]

Bench = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """Runs a benchmark with options as one text; its rows."""

    def run(text: str, *more: str) -> list[dict[str, Any]]:
        file = tmp_path / "figures.json"
        done = CliRunner().invoke(app, [*text.split(), *more, "--json", str(file)])
        assert done.exit_code == 0, done.output
        rows: list[dict[str, Any]] = json.loads(file.read_text())["rows"]
        for title in {row["table"] for row in rows}:
            assert title in " ".join(done.stdout.split())  # wide titles are wrapped
        return rows

    return run


@pytest.fixture
def refused() -> Callable[..., str]:
    """Runs a benchmark that does not begin; what it says on stderr."""

    def run(text: str, *more: str) -> str:
        done = CliRunner().invoke(app, [*text.split(), *more])
        assert done.exit_code == 2, done.output
        assert not done.stdout
        return " ".join(done.stderr.split())

    return run
