"""Tables of figures on the screen, and files of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from saga_fg.errors import InputError

if TYPE_CHECKING:
    from data_tools.figures import FigureTable


def writable(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written before the work begins."""
    if path is not None:
        from data_tools.files.atomic_files import check_writable

        check_writable(path)
    return path


def writable_picture(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written, or whose name does not say that it is a PNG file."""
    if path is not None and path.suffix.lower() != ".png":
        raise InputError(f"{path}: expected a name that ends in .png")
    return writable(path)


JsonFile = Annotated[
    Path | None,
    typer.Option("--json", help="Write the figures to this file too.", metavar="FILE", callback=writable),
]
MarkdownFile = Annotated[
    Path | None,
    typer.Option("--markdown", help="Write the tables to this file too.", metavar="FILE", callback=writable),
]
PictureFile = Annotated[
    Path | None,
    typer.Option("--plot", help="Draw the figures to this PNG file too.", metavar="FILE", callback=writable_picture),
]


def report(tables: Iterable[FigureTable], figures: Any, json_file: Path | None, markdown: Path | None = None) -> None:
    """Print the tables, and write the figures and the tables to the files that were asked for."""
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import write_text

    tables = list(tables)
    show_tables(tables)
    if json_file is not None:
        write_figures(json_file, figures)
    if markdown is not None:
        write_text(markdown, "\n".join(table.markdown() for table in tables))


def show_summary(table: FigureTable, legend: str) -> None:
    """Print one table without lines, which is narrow, and what its columns mean."""
    shown = Table(title=table.title, title_justify="left", box=None, padding=(0, 1), collapse_padding=True)
    for n, column in enumerate(table.columns):
        shown.add_column(column, justify="right" if n else "left", no_wrap=True)
    for row in table.rows:
        shown.add_row(*row)
    Console(width=max(Console().width, 80)).print(shown)
    typer.echo(legend)


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
