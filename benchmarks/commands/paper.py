"""`python -m benchmarks paper`: the paper's table on given recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables


def paper(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds v1.0-mini/, in the nuScenes layout.")],
    split: Annotated[str, typer.Option("--split", help="Scenes that both sensors saw.")],
    camera: Annotated[Path, typer.Option("--camera", help="Detection-result JSON of the camera.")],
    lidar: Annotated[Path, typer.Option("--lidar", help="Detection-result JSON of the LiDAR.")],
    config: Config = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Camera, LiDAR and both together, by every method: AMOTA, AMOTP and identity switches beside the paper's.

    \b
    Examples:
      python -m benchmarks paper --dataroot data/nuscenes --split camera \\
          --camera data/nuscenes/detections/fastbev_camera.json \\
          --lidar data/nuscenes/detections/centerpoint_lidar.json
      python -m benchmarks paper --dataroot simulated --split all \\
          --camera simulated/detections/camera.json --lidar simulated/detections/lidar.json
    """
    from benchmarks.paper import PUBLISHED, paper_table, shown
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from pipelines.config import load_config

    if json_file is not None:
        check_writable(json_file)
    with progress_bar() as progress:
        measured = paper_table(dataroot, split, camera, lidar, load_config("nuscenes", config), progress)
    show_tables([shown(measured, split)])
    if json_file is not None:
        write_figures(json_file, {"measured": measured, "paper": PUBLISHED})
