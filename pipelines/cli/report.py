"""`saga-fg report`: a page to look at a result with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli.console import working
from pipelines.cli.datasets import Source, dataset_commands

if TYPE_CHECKING:
    from data_tools.datasets.source import DatasetSource


def _report(
    source: DatasetSource,
    result: options.Result,
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")],
    beside: Annotated[
        Path | None,
        typer.Option("--beside", help="Another result of the same recordings, to show side by side.", metavar="RESULT"),
    ] = None,
    images: Annotated[
        int, typer.Option("--images", min=0, help="Width of the camera images in the page, pixels; 0 leaves them out.")
    ] = 240,
    verbose: options.Verbose = False,
) -> None:
    """Make a page of a tracking result: a player, charts, and figures, of errors where there is ground truth."""
    from data_tools.files.atomic_files import check_writable, write_text
    from pipelines.report import report_page, result_report
    from saga_fg.errors import InputError

    options.apart(output, result, *([] if beside is None else [beside]), *source.input_files())
    if output.suffix not in (".html", ".htm"):
        raise InputError(f"{output}: expected a file name that ends in .html")
    check_writable(output)
    with working("making the page"):
        page = report_page(result_report(source, result, beside, images))
        write_text(output, page)
    typer.echo(f"{output}: {len(page) / 1e6:.1f} MB")


def _texts(source: Source) -> dict[str, str | None]:
    """Options of datasets without camera images."""
    from data_tools.datasets.source import DatasetSource

    return {"images": None} if source.images is DatasetSource.images else {}


_commands = dataset_commands(
    "report",
    _report,
    ("report {result} --output report.html", "report {result} --beside other/{tracks} --output report.html"),
    _texts,
)
report_app = typer.Typer(cls=_commands, no_args_is_help=True, rich_markup_mode=None)


@report_app.callback()
def report() -> None:
    """Make a page of a result: a player, figures, charts; one HTML file that needs no network."""
