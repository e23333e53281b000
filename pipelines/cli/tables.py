"""Tables of figures on the screen, and JSON files of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from data_tools.figures import FigureTable

JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file too.", metavar="FILE")]


def show_tables(tables: Iterable[FigureTable]) -> None:
    """Print the tables on stdout, each as wide as it needs to be: broken lines are no table any more."""
    for table in tables:
        shown = Table(title=table.title, title_justify="left")
        for n, column in enumerate(table.columns):
            shown.add_column(column, justify="right" if n else "left")
        for row in table.rows:
            shown.add_row(*row)
        widths = (max(map(len, texts)) for texts in zip(table.columns, *table.rows, strict=True))
        needed = max(len(table.title), sum(width + 3 for width in widths) + 1)
        Console(width=max(Console().width, needed)).print(shown)
