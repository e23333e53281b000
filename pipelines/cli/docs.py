"""`saga-fg docs`: where the documentation is."""

from __future__ import annotations

from importlib.metadata import metadata
from pathlib import Path
from typing import Annotated

import typer

from data_tools.files.error_messages import unknown_name
from saga_fg.errors import InputError

PAGES = Path(__file__).resolve().parents[2] / "docs"
"""In a clone; not part of the installed package."""


def docs(
    page: Annotated[str, typer.Argument(help="A page, e.g. formats or guides/stream.")] = "index",
) -> None:
    """Say where a page of the documentation is: its file in a clone, else its address.

    \b
    Examples:
      saga-fg docs
      saga-fg docs formats
    """
    typer.echo(location(page.removesuffix(".md").removeprefix("docs/"), PAGES))


def location(page: str, folder: Path) -> str:
    """Return the path of a page in `folder`, or its address. Raises `InputError` for a page that a clone lacks."""
    known = {path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.md"))}
    if known and page not in known:
        raise InputError(unknown_name("page", page, tuple(known)))
    return str(known[page]) if known else f"{_address()}/{page}.md"


def _address() -> str:
    urls: dict[str, str] = dict(entry.split(", ", 1) for entry in metadata("saga-fg").get_all("Project-URL", []))
    return urls["Documentation"]
