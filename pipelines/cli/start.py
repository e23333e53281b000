"""`saga-fg config`, `saga-fg demo` and `saga-fg simulate`: settings and recordings to begin with."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from data_tools.datasets.nuscenes import write_nuscenes
from data_tools.datasets.source import dataset_source
from data_tools.simulator import ScenarioName, SimulatedTraffic, SimulatorSettings, scenario_settings
from pipelines.cli.console import counted, progress_bar, show_tables, working
from pipelines.cli.options import Config, Verbose, as_command
from pipelines.config import Family, load_config
from pipelines.configuration import load_settings, write_settings
from pipelines.demo import MERGE_NOTE, comparison_table, merge_lines, run_demo, write_simulated_tables
from pipelines.serving import StreamSettings
from pipelines.slam.configuration import load_slam_config
from pipelines.smoothing import load_smooth_config
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
        "smoothing.max_gap",
        "smoothing.loss",
        "smoothing.min_score",
        "sensors.*.noise.*.position",
    ),
    "slam": (
        "slam.laser.largest_range",
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


@dataclass(frozen=True)
class KindOptions:
    """Which settings are printed, those of tracking if none is chosen."""

    simulator: Annotated[bool, typer.Option("--simulator", help="The simulator's settings instead.")] = False
    smoothing: Annotated[bool, typer.Option("--smoothing", help="Those of `saga-fg smooth` instead.")] = False
    slam: Annotated[bool, typer.Option("--slam", help="Those of `saga-fg slam` instead.")] = False
    limits: Annotated[bool, typer.Option("--limits", help="Those of `saga-fg serve --limits` instead.")] = False


def _config(
    *,
    kind: Annotated[
        str,
        typer.Option(
            "--for",
            help="Dataset whose shipped settings to print; or heterogeneous: traffic lights, cones, trailers; or "
            "dense: traffic seen from above or the roadside.",
            metavar="NAME",
        ),
    ] = "file",
    full: Annotated[bool, typer.Option("--full", help="All settings, not only the five one changes first.")] = False,
    kinds: KindOptions,
    file: Annotated[
        Path | None, typer.Option("--config", help="Print the settings this YAML file leads to.", metavar="FILE")
    ] = None,
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
    chosen = [name for name, wanted in vars(kinds).items() if wanted]
    if len(chosen) > 1:
        raise InputError("expected one of --simulator, --smoothing, --slam and --limits")
    (name,) = chosen or ("tracking",)
    settings: Any
    if name in ("simulator", "limits"):
        cls: type[Any] = SimulatorSettings if kinds.simulator else StreamSettings
        settings = load_settings(cls, file) if file else cls()
    else:
        load = {"smoothing": load_smooth_config, "slam": load_slam_config, "tracking": load_config}[name]
        family = kind if kind in get_args(Family) else dataset_source(kind).family
        settings = load(family, file)
    text = write_settings(settings) if full else POINTER + write_settings(settings, selection=FIRST[name])
    typer.echo(text, nl=False)


config = as_command(_config)

READING = """\
MOTA counts missed objects, false boxes and identity switches. kf and saga go on reporting hidden objects, centerpoint
does not. A hidden object without a box is no miss, but a box farther than 2 m from all objects is false, so a method
that predicts hidden objects badly loses MOTA."""


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the page.")] = Path("saga-fg-demo"),
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of simulated scenes.")] = 3,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the simulation.")] = 0,
    scenario: Annotated[
        ScenarioName,
        typer.Option("--scenario", help="What the scenes are about; those with a map by the heterogeneous settings."),
    ] = "traffic",
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Simulate traffic, track it with three methods, and compare them.

    Prints a table, and writes an HTML page with a player. Takes less than a minute.

    \b
    Examples:
      saga-fg demo
      saga-fg demo --output out --scenes 1 --seed 3
      saga-fg demo --output out --scenario road-works --scenes 1
    """
    with progress_bar() as progress:
        family = "traffic" if scenario == "merge" else "simulated" if scenario in MAPLESS else "heterogeneous"
        merge = scenario_settings("merge") if scenario == "traffic" else None
        settings = load_config(family, config)
        comparison = run_demo(output, settings, scenario_settings(scenario), scenes, seed, progress, merge)
    title = f"{counted(scenes, 'simulated scene')}, seed {seed}"
    show_tables([comparison_table(comparison, title)])
    typer.echo(READING)
    if comparison.merge:
        typer.echo("\n".join([MERGE_NOTE, *merge_lines(comparison.merge["saga"])]))
    typer.echo(f"page: {output / 'index.html'}")


MAPLESS: tuple[ScenarioName, ...] = ("traffic", "merge", "two-sensors")
"""Scenarios without lights and lanes as objects, which the nuScenes layout has no place for."""


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    scenario: Annotated[
        ScenarioName,
        typer.Option("--scenario", help="What the scenes are about; those with a map are written as tables."),
    ] = "traffic",
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file; see `saga-fg config --simulator`.", metavar="FILE")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Simulate traffic, and write it in the nuScenes layout, or as tables.

    Tables of nuScenes with ground truth go to v1.0-mini/, the detections of every sensor to detections/.
    nuScenes knows no lights and no lanes, so other scenarios get a folder for each scene: detections.csv with the
    colours of lights, truth.csv, and settings.yaml with the map of the scene.

    \b
    Examples:
      saga-fg simulate --output simulated --scenes 4 --seed 0
      saga-fg track nuscenes --dataroot simulated --split all \\
          --detections lidar=simulated/detections/lidar.json --output tracks.json
      saga-fg simulate --output junctions --scenario red-light --scenes 2
      saga-fg track file junctions/scene-0001/detections.csv \\
          --config junctions/scene-0001/settings.yaml --output tracks.csv
    """
    settings = scenario_settings(scenario)
    if config is not None:
        settings = load_settings(SimulatorSettings, config, settings)
    made = f"{output}: {counted(scenes, 'scene')} of {settings.duration:g} s, seed {seed}"
    traffic = SimulatedTraffic(settings, scenes, seed)
    with working(f"simulating {counted(scenes, 'scene')}"):
        if scenario in MAPLESS:
            write_nuscenes(output, traffic, traffic.mounts)
        else:
            write_simulated_tables(output, traffic)
    if scenario not in MAPLESS:
        typer.echo(f"{made}; in each folder detections.csv, truth.csv, settings.yaml")
        return
    detections = ", ".join(str(output / "detections" / f"{name}.json") for name in settings.sensors)
    typer.echo(f"{made}; detections: {detections}")
