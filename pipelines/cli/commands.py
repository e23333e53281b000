"""The command `saga-fg` and its sub-commands."""

from __future__ import annotations

from typing import Annotated

import typer

from pipelines.cli.benchmark import benchmark_app
from pipelines.cli.config import config
from pipelines.cli.console import new_command
from pipelines.cli.demo import demo
from pipelines.cli.docs import docs
from pipelines.cli.evaluate import evaluate_app
from pipelines.cli.explain import explain
from pipelines.cli.inspect import inspect_table
from pipelines.cli.learn import learn_app
from pipelines.cli.report import report_app
from pipelines.cli.serve import serve, status
from pipelines.cli.simulate import simulate
from pipelines.cli.slam import slam_app
from pipelines.cli.smooth import smooth_app
from pipelines.cli.track import track_app
from pipelines.cli.view import view_app
from saga_fg import __version__

app = new_command()
app.command("inspect")(inspect_table)
app.add_typer(track_app, name="track")
app.add_typer(smooth_app, name="smooth")
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(learn_app, name="learn")
app.add_typer(report_app, name="report")
app.add_typer(view_app, name="view")
app.add_typer(benchmark_app, name="benchmark")
app.add_typer(slam_app, name="slam")
app.command()(explain)
app.command()(simulate)
app.command()(demo)
app.command()(serve)
app.command()(status)
app.command()(config)
app.command()(docs)


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
    """Track many interacting objects with a graph-aware Kalman filter.

    Start with `saga-fg demo`; then `saga-fg track --help` for recordings.
    """
