"""`saga-fg config`: every setting with its default and its meaning."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pipelines.cli.options import Verbose
from saga_fg.errors import InputError


def config(
    kind: Annotated[
        Literal["file", "nuscenes", "kitti", "simulated", "heterogeneous"],
        typer.Option("--for", help="The kind of data whose shipped defaults to print."),
    ] = "file",
    simulator: Annotated[bool, typer.Option("--simulator", help="The simulator's settings instead.")] = False,
    smoothing: Annotated[bool, typer.Option("--smoothing", help="Those of `saga-fg smooth` instead.")] = False,
    slam: Annotated[bool, typer.Option("--slam", help="Those of `saga-fg slam` instead.")] = False,
    limits: Annotated[bool, typer.Option("--limits", help="Those of `saga-fg serve --limits` instead.")] = False,
    file: Annotated[
        Path | None, typer.Option("--config", help="Print the settings this YAML file leads to.", metavar="FILE")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="The reference in Markdown instead of YAML.")] = False,
    verbose: Verbose = False,
) -> None:
    """Print every setting, its default and what it means, as YAML to edit and pass to `--config`.

    A file needs to hold only what it changes.

    \b
    Examples:
      saga-fg config > mine.yaml                      # everything, to edit
      saga-fg config --for kitti --config mine.yaml   # what mine.yaml makes of the defaults for KITTI
      saga-fg config --smoothing --for nuscenes       # settings of `saga-fg smooth`
      saga-fg config --simulator                      # settings of `saga-fg simulate`
      saga-fg config --slam --for kitti               # settings of `saga-fg slam`
      saga-fg config --limits                         # limits of `saga-fg serve`
    """
    from data_tools.simulator import SimulatorSettings
    from pipelines.config import TrackConfig, load_config
    from pipelines.configuration import load_settings, settings_reference, write_settings
    from pipelines.serving import StreamSettings
    from pipelines.slam.configuration import SlamConfig, load_slam_config
    from pipelines.smoothing import SmoothConfig, load_smooth_config

    if simulator + smoothing + slam + limits > 1:
        raise InputError("expected one of --simulator, --smoothing, --slam and --limits")
    plain: type[Any] | None = SimulatorSettings if simulator else StreamSettings if limits else None
    if markdown:
        text = settings_reference(plain or (SmoothConfig if smoothing else SlamConfig if slam else TrackConfig))
    elif smoothing:
        text = write_settings(load_smooth_config(kind, file))
    elif slam:
        text = write_settings(load_slam_config(kind, file))
    elif plain is not None:
        text = write_settings(load_settings(plain, file) if file else plain())
    else:
        text = write_settings(load_config(kind, file))
    typer.echo(text, nl=False)
