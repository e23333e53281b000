"""`saga-fg docs`: pages of a clone, and addresses without one."""

from __future__ import annotations

from importlib.metadata import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.cli.commands import PAGES, location
from saga_fg import InputError


def test_a_clone_has_its_pages() -> None:
    run = CliRunner().invoke(app, ["docs", "guides/stream"])
    assert run.exit_code == 0
    assert Path(run.stdout.strip()).read_text(encoding="utf-8").startswith("# ")
    with pytest.raises(InputError, match=r"unknown page 'formatz'.*formats"):
        location("formatz", PAGES)


def test_elsewhere_they_have_addresses(tmp_path: Path) -> None:
    if not metadata("saga-fg").get_all("Project-URL"):
        pytest.skip("the installed metadata is older than the addresses: pip install -e .")
    address = location("formats", tmp_path)
    assert address.startswith("https://")
    assert address.endswith("/docs/formats.md")
