"""`saga-fg slam`: trajectories and maps, from recordings and graph files."""

from __future__ import annotations

import typer

from pipelines.cli.console import ReportingGroup
from pipelines.cli.slam_g2o import g2o
from pipelines.cli.slam_generate import generate
from pipelines.cli.slam_kitti import kitti
from pipelines.cli.slam_laser import laser
from pipelines.cli.slam_simulated import simulated

slam_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)
slam_app.command()(g2o)
slam_app.command()(kitti)
slam_app.command()(generate)
slam_app.command()(laser)
slam_app.command()(simulated)


@slam_app.callback()
def slam() -> None:
    """Estimate where the vehicle was and what stands around it, in one factor graph."""
