"""Output of the command: results and tables on stdout and in files; progress, warnings and one-line errors on stderr.

Exit codes: 0 done, 2 wrong arguments or input (`SagaError`), 130 interrupted, 143 terminated (`main`); anything else is
a bug and a traceback.
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from typer.core import TyperGroup

from saga_fg.errors import SagaError

if TYPE_CHECKING:
    from data_tools.figures import FigureTable
    from pipelines.tracking import Progress as ProgressCallback

log = logging.getLogger(__name__)

INPUT_ERROR, INTERRUPTED = 2, 130


@functools.cache
def error_console() -> Console:
    """The one console on stderr, shared by log lines and progress bar so that they do not run into each other."""
    return Console(stderr=True)


def _factor_error() -> type[Exception]:
    """Exception of `factors`, `SagaError` while that package is not imported."""
    raised: type[Exception] = getattr(sys.modules.get("factors.validation"), "FactorError", SagaError)
    return raised


class ReportingGroup(TyperGroup):
    """Turns what a command raises into a line on stderr and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except (SagaError, _factor_error()) as error:
            log.debug("where the error was found", exc_info=error)
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(INPUT_ERROR) from error
        except KeyboardInterrupt as error:
            typer.echo("interrupted: nothing was written", err=True)
            raise typer.Exit(INTERRUPTED) from error


def _no_options() -> None:
    """A group is a group even while nothing has been added to it."""


def new_group(text: str, cls: type[TyperGroup] = ReportingGroup) -> typer.Typer:
    """A command whose sub-commands are to be added."""
    return typer.Typer(
        cls=cls,
        help=text,
        callback=_no_options,
        no_args_is_help=True,
        rich_markup_mode=None,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def new_command(run: Callable[..., None], name: str, **settings: Any) -> Any:
    """A function as a command, without the Typer around it; settings: as `typer.Typer.command` takes them."""
    app = typer.Typer(rich_markup_mode=None, add_completion=False)
    app.command(name, **settings)(run)
    return typer.main.get_command(app)


class _ConsoleHandler(logging.Handler):
    """Log lines above the progress bar, neither wrapped nor coloured."""

    def emit(self, record: logging.LogRecord) -> None:
        error_console().print(self.format(record), markup=False, highlight=False, soft_wrap=True)


def set_up_logging(verbose: bool) -> None:
    """Warnings to stderr; with `verbose` everything that is logged, and tracebacks with errors."""
    level = logging.DEBUG if verbose else logging.WARNING
    for name in ("factors", "saga_fg", "data_tools", "pipelines"):  # other libraries' debug lines are not ours to show
        logging.getLogger(name).setLevel(level)
    root = logging.getLogger()
    if not any(isinstance(handler, _ConsoleHandler) for handler in root.handlers):
        handler = _ConsoleHandler()
        handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
        root.addHandler(handler)


def working(what: str) -> AbstractContextManager[object]:
    """Says what is going on while it goes on, on stderr; nothing where stderr is not a terminal."""
    console = error_console()
    return console.status(what) if console.is_terminal else nullcontext()


@contextmanager
def progress_bar(scenes: int | None = None, unit: str = "frames") -> Iterator[ProgressCallback]:
    """A progress callback that draws a bar on stderr, and draws nothing where stderr is not a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    console = error_console()
    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("reading")
        seen: list[str] = []

        def advance(scene: str, done: int, total: int) -> None:
            if not seen or seen[-1] != scene:
                seen.append(scene)
            of = f"/{scenes}" if scenes else ""
            bar.update(task, description=f"{scene} ({len(seen)}{of})", completed=done, total=total)

        yield advance


def writable(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written before the work begins."""
    if path is not None:
        from data_tools.files import check_writable

        check_writable(path)
    return path


JsonFile = Annotated[
    Path | None,
    typer.Option("--json", help="Write the figures to this file too.", metavar="FILE", callback=writable),
]
MarkdownFile = Annotated[
    Path | None,
    typer.Option("--markdown", help="Write the tables to this file too.", metavar="FILE", callback=writable),
]


def report(tables: Iterable[FigureTable], figures: Any, json_file: Path | None, markdown: Path | None = None) -> None:
    """Print the tables, and write the figures and the tables to the files that were asked for."""
    from data_tools.figures import write_figures
    from data_tools.files import write_text

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


def counted(number: int, noun: str) -> str:
    """`1 box`, `2 boxes`."""
    plural = "" if number == 1 else "es" if noun.endswith("x") else "s"
    return f"{number} {noun}{plural}"
