"""`saga-fg config`: the settings with their defaults and meanings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.cli.options import Verbose
from saga_fg.errors import InputError

# Of each kind of settings, those one changes first.
FIRST = {
    "tracking": (
        "tracker.min_hits",
        "tracker.estimator",
        "tracker.classes.*.motion",
        "tracker.classes.*.max_deviation",
        "sensors.*.noise.*.position",
    ),
    "smoothing": (
        "smoothing.classes.*.acceleration_noise",
        "smoothing.stitching.max_gap",
        "smoothing.loss",
        "smoothing.min_score",
        "sensors.*.noise.*.position",
    ),
    "slam": (
        "slam.joint.odometry.distance_noise",
        "slam.lidar.odometry.surfel_size",
        "slam.lidar.loops.drift",
        "slam.lidar.landmarks",
        "slam.lidar.loop_closures",
    ),
    "simulator": (
        "duration",
        "keyframe_rate",
        "traffic.signal_probability",
        "sensors.*.detection_probability",
        "sensors.*.clutter_rate",
    ),
    "limits": ("reorder", "max_detections", "max_clients", "client_timeout", "idle_timeout"),
}
POINTER = """\
# The five settings one changes first. `saga-fg config --full` prints all of them, the page Configuration lists them.
"""


def config(
    kind: Annotated[
        str,
        typer.Option(
            "--for",
            help="Dataset whose shipped settings to print; or heterogeneous: traffic lights, cones, trailers.",
            metavar="NAME",
        ),
    ] = "file",
    full: Annotated[bool, typer.Option("--full", help="All settings, not only the five one changes first.")] = False,
    simulator: Annotated[bool, typer.Option("--simulator", help="The simulator's settings instead.")] = False,
    smoothing: Annotated[bool, typer.Option("--smoothing", help="Those of `saga-fg smooth` instead.")] = False,
    slam: Annotated[bool, typer.Option("--slam", help="Those of `saga-fg slam` instead.")] = False,
    limits: Annotated[bool, typer.Option("--limits", help="Those of `saga-fg serve --limits` instead.")] = False,
    file: Annotated[
        Path | None, typer.Option("--config", help="Print the settings this YAML file leads to.", metavar="FILE")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="All settings as tables in Markdown.")] = False,
    verbose: Verbose = False,
) -> None:
    """Print settings, their defaults and what they mean, as YAML to edit and pass to `--config`.

    A file needs to hold only what it changes.

    \b
    Examples:
      saga-fg config > mine.yaml                             # the five settings one changes first
      saga-fg config --full > mine.yaml                      # everything
      saga-fg config --for kitti --config mine.yaml --full   # what mine.yaml makes of the defaults for KITTI
      saga-fg config --smoothing --for nuscenes              # settings of `saga-fg smooth`
      saga-fg config --simulator                             # settings of `saga-fg simulate`
      saga-fg config --slam --for kitti                      # settings of `saga-fg slam`
      saga-fg config --limits                                # limits of `saga-fg serve`
    """
    from data_tools.datasets.registry import dataset_source
    from data_tools.simulator import SimulatorSettings
    from pipelines.config import load_config
    from pipelines.configuration import load_settings, settings_reference, write_settings
    from pipelines.serving import StreamSettings
    from pipelines.slam.configuration import load_slam_config
    from pipelines.smoothing import load_smooth_config

    chosen = {"simulator": simulator, "smoothing": smoothing, "slam": slam, "limits": limits}
    if sum(chosen.values()) > 1:
        raise InputError("expected one of --simulator, --smoothing, --slam and --limits")
    name = next((name for name, wanted in chosen.items() if wanted), "tracking")
    settings: Any
    if name in ("simulator", "limits"):
        cls: type[Any] = SimulatorSettings if simulator else StreamSettings
        settings = load_settings(cls, file) if file else cls()
    else:
        load = {"smoothing": load_smooth_config, "slam": load_slam_config, "tracking": load_config}[name]
        family = kind if kind == "heterogeneous" else dataset_source(kind).family
        settings = load(family, file)
    if markdown:
        text = settings_reference(type(settings))
    elif full:
        text = write_settings(settings)
    else:
        text = POINTER + write_settings(settings, selection=FIRST[name])
    typer.echo(text, nl=False)
