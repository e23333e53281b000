"""`saga-fg review`: labels corrected on a page."""

import os
import signal
from contextlib import chdir, suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated

import typer

from data_tools.files import check_writable, write_text
from pipelines.cli.console import counted, working
from pipelines.cli.options import Verbose, as_command
from pipelines.review import (
    CORRECTIONS,
    ReviewServer,
    ReviewSession,
    export_labels,
    import_edits,
    read_label_run,
)
from saga_fg.errors import InputError


@dataclass(frozen=True)
class InsteadOptions:
    """Outputs other than the served page: a page as a file, an export, or edits to import."""

    page: Annotated[
        Path | None,
        typer.Option(
            "--page",
            help="Write the page to a file instead, to be opened without a server: it keeps corrections until they are "
            "saved, and solves nothing again.",
            metavar="FILE",
        ),
    ] = None
    out: Annotated[
        tuple[str, Path] | None,
        typer.Option(
            "--export",
            help="Write the labels for a labelling tool instead: openlabel, cvat or sustechpoints, and a folder.",
            metavar="TOOL DIR",
        ),
    ] = None
    back: Annotated[
        tuple[str, Path] | None,
        typer.Option(
            "--import",
            help="Add what was changed in a labelling tool to the corrections instead: its name, and the folder.",
            metavar="TOOL DIR",
        ),
    ] = None


def _review(
    folder: Annotated[Path, typer.Argument(help="Folder that saga-fg smooth wrote.")],
    instead: InsteadOptions,
    corrections: Annotated[
        Path | None,
        typer.Option(
            "--corrections",
            help="File of corrections to go on with.  [default: that of the labels, else corrections.jsonl in FOLDER]",
            metavar="FILE",
        ),
    ] = None,
    who: Annotated[str | None, typer.Option("--who", help="Your name in corrections.  [default: as logged in]")] = None,
    images: Annotated[
        int, typer.Option("--images", min=0, help="Width of the camera images in the page, pixels; 0 leaves them out.")
    ] = 240,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port on 127.0.0.1; 0: any that is free.")] = 0,
    verbose: Verbose = False,
) -> None:
    """Correct labels on a page: objects by what a look is worth, boxes moved and turned from above, keys for the rest.

    The page is served on 127.0.0.1, behind a token in its address; nothing leaves the machine. Every
    correction is in the file before the page shows it. Its scene is solved again, and what changed is marked.
    Ctrl-C ends the server. `saga-fg smooth ... --corrections FILE` makes labels with the corrections.

    \b
    Examples:
      saga-fg review labels
      saga-fg review labels --corrections mine.jsonl --who anna
      saga-fg review labels --page review.html   # for somebody without saga-fg
      saga-fg review labels --export cvat boxes   # then, with what was changed there
      saga-fg review labels --import cvat boxes
    """
    page, out, back = instead.page, instead.out, instead.back
    if page is not None and page.suffix not in (".html", ".htm"):
        raise InputError(f"{page}: expected a file name that ends in .html")
    if sum(one is not None for one in (page, out, back)) > 1:
        raise InputError("expected one of --page, --export and --import")
    who = os.environ.get("USER", "") if who is None else who
    out, back = ((each and (each[0], each[1].absolute())) for each in (out, back))
    run, folder, page = read_label_run(folder), folder.absolute(), page and page.absolute()
    given = Path(run.directory, run.corrections) if run.corrections else folder / CORRECTIONS
    file = given if corrections is None else corrections.absolute()
    check_writable(page or file)
    with chdir(run.directory):
        if out is not None:
            boxes, clouds, without = export_labels(folder, run, *out)
            unsized = f"; {counted(without, 'box')} without a size left out" if without else ""
            typer.echo(f"{out[1]}: {counted(boxes, 'box')}, {counted(clouds, 'point cloud')}{unsized}")
            return
        if back is not None:
            kinds, problems = import_edits(folder, run, *back, file, who)
            for line in problems:
                typer.echo(f"not taken over: {line}", err=True)
            listed = ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "nothing was changed"
            typer.echo(f"{file}: {counted(kinds.total(), 'new correction')}: {listed}")
            return
        with working("reading the recordings"):
            session = ReviewSession(folder, run, file, who, images)
        if page is not None:
            write_text(page, session.page(server=False))
            typer.echo(f"{page}: open it in a browser; what it saves goes to saga-fg smooth ... --corrections FILE")
            return
        signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it for what runs in the background
        with ReviewServer(session, port) as server, suppress(KeyboardInterrupt):
            typer.echo(f"{server.url}\nCorrections go to {file}; Ctrl-C ends.")
            server.serve_forever()
        typer.echo(f"labels with the corrections: saga-fg smooth ... --corrections {quote(str(file))}", err=True)


review = as_command(_review)
