"""`saga-fg simulate`: traffic with ground truth and detections, in the nuScenes layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.reporting import working
from pipelines.cli.summary import counted


def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file; see `saga-fg config --simulator`.", metavar="FILE")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Simulate traffic, and write it in the nuScenes layout.

    Tables with ground truth go to v1.0-mini/, the detections of every sensor to detections/.

    \b
    Example:
      saga-fg simulate --output simulated --scenes 4 --seed 0
      saga-fg track nuscenes --dataroot simulated --split all \\
          --detections lidar=simulated/detections/lidar.json --output tracks.json
    """
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings, write_nuscenes
    from pipelines.configuration import load_settings

    settings = load_settings(SimulatorSettings, config) if config is not None else SimulatorSettings()
    with working(f"simulating {counted(scenes, 'scene')}"):
        write_nuscenes(output, SimulatedTraffic(settings, scenes, seed))
    detections = ", ".join(str(output / "detections" / f"{name}.json") for name in settings.sensors)
    typer.echo(
        f"{output}: {counted(scenes, 'scene')} of {settings.duration:g} s, seed {seed}; detections: {detections}"
    )
