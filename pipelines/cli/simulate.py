"""`saga-fg simulate`: traffic with ground truth and detections, in the nuScenes layout or as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.console import working
from pipelines.cli.options import Scenario, Verbose
from pipelines.cli.summary import counted

MAPLESS: tuple[Scenario, ...] = ("traffic", "two-sensors")
"""Scenarios without lights and lanes as objects, which the nuScenes layout has no place for."""


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    scenario: Annotated[
        Scenario,
        typer.Option(
            "--scenario", help="What the scenes are about; all but traffic and two-sensors are written as tables."
        ),
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
    from data_tools.datasets.nuscenes import write_nuscenes
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from data_tools.simulator.scenarios import scenario_settings
    from pipelines.configuration import load_settings
    from pipelines.simulated_tables import write_simulated_tables

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
