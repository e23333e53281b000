"""Output of the command: results on stdout; progress, warnings and one-line errors on stderr.

Exit codes: 0 done, 2 wrong arguments or input (`SagaError`), 130 interrupted, 143 terminated (`main`); anything else is
a bug and a traceback.
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from typer.core import TyperGroup

from saga_fg.errors import SagaError

if TYPE_CHECKING:
    from pipelines.tracking import Progress as ProgressCallback

log = logging.getLogger(__name__)

INPUT_ERROR, INTERRUPTED = 2, 130


@functools.cache
def error_console() -> Console:
    """The one console on stderr, shared by log lines and progress bar so that they do not run into each other."""
    return Console(stderr=True)


def _factor_error() -> type[Exception]:
    """Exception of `factors`, `SagaError` while that package is not imported."""
    raised: type[Exception] = getattr(sys.modules.get("factors.errors"), "FactorError", SagaError)
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


def new_command() -> typer.Typer:
    """A command of its own, whose sub-commands are to be added."""
    return typer.Typer(
        cls=ReportingGroup,
        no_args_is_help=True,
        rich_markup_mode=None,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


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
