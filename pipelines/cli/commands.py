"""The command `saga-fg`: its sub-commands by name, each in a module that is imported when it is asked for."""

from importlib import import_module
from importlib.metadata import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from pipelines.cli.console import ReportingGroup, new_command, new_group
from saga_fg import __version__
from saga_fg.errors import InputError, unknown_name

COMMANDS = {
    "inspect": ("inspect:inspect_table", "Look at a table: its columns, units, classes, times, faults."),
    "track": ("track:track_app", "Track recorded detections of a dataset."),
    "smooth": ("track:smooth_app", "Make labels of recorded detections, from past and future."),
    "evaluate": ("evaluate:evaluate_app", "Compare results with the ground truth."),
    "learn": ("learn:learn_app", "Learn settings from recordings."),
    "review": ("review:review", "Correct labels on a page, those most worth a look first."),
    "report": ("report:report_app", "Make a page of a result: a player, figures, charts."),
    "view": ("report:view_app", "See a result in space, in rerun or Foxglove."),
    "benchmark": ("evaluate:benchmark_app", "Get the figures of a whole dataset, and the submission."),
    "slam": ("slam:slam_app", "Estimate the vehicle's path and a map, in one factor graph."),
    "explain": ("inspect:explain", "Tell the life of a track, or draw the running graph."),
    "simulate": ("start:simulate", "Simulate traffic, and write it as recordings."),
    "demo": ("start:demo", "Simulate traffic, track it with three methods, compare them."),
    "serve": ("serve:serve", "Track live: detections in, tracks out, as lines of JSON."),
    "serve ros2": ("serve:serve_ros2", "Track live over DDS, as a node of ROS 2 does."),
    "status": ("serve:status", "Ask a running service for its counts and latencies."),
    "config": ("start:config", "Print settings, their defaults and what they mean, as YAML."),
    "docs": ("commands:docs", "Say where a page of the documentation is."),
}
"""Module in this folder and name in it of each sub-command, and its line in the list of all."""


class LazyGroup(ReportingGroup):
    """The group of `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = dict.fromkeys(COMMANDS, TyperCommand(None))  # listed, and suggested

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name][0].partition(":")
        found = getattr(import_module(f"pipelines.cli.{module}"), name)
        return typer.main.get_command(found) if isinstance(found, typer.Typer) else new_command(found, cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = " ".join(args[:2])
        return (name, self.get_command(ctx, name), args[2:]) if name in COMMANDS else super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


app = new_group(
    "Track many interacting objects with a graph-aware Kalman filter.\n\n"
    "Start with `saga-fg demo`; then `saga-fg track --help` for recordings.",
    LazyGroup,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"saga-fg {__version__}")
        raise typer.Exit


@app.callback()
def saga_fg(
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    pass


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
