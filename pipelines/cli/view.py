"""`saga-fg view`: a result in space, in the viewer rerun or as a file for rerun or Foxglove."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli.reporting import ReportingGroup, working

if TYPE_CHECKING:
    from pipelines.view import SceneView

view_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

Save = Annotated[
    Path | None,
    typer.Option(
        "--save",
        help="Write a file instead of opening the viewer: .rrd for rerun, .mcap for Foxglove (extra [mcap]).",
        metavar="FILE",
    ),
]
Spacing = Annotated[
    float, typer.Option("--spacing", min=0.0, help="Thin the LiDAR's points to this, m; 0 leaves them out.")
]


@view_app.callback()
def view() -> None:
    """See a result in space: boxes, tracks, ellipses, edges, graph, truth, LiDAR, landmarks (rerun or Foxglove)."""


@view_app.command()
def nuscenes(
    result: options.TrackingResult,
    dataroot: options.Tables,
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    detections: options.SeenBySensors = None,
    spacing: Spacing = 0.1,
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See a nuScenes tracking result, with the ground truth and the LiDAR scans where their files are there.

    \b
    Examples:
      saga-fg view nuscenes tracks.json --dataroot data/nuscenes --scenes scene-0103
      saga-fg view nuscenes tracks.json --dataroot data/nuscenes --split mini_train \\
          --detections lidar=megvii.json --save tracks.mcap
    """
    from pipelines.view.sources import nuscenes_view

    chosen, files = options.chosen_scenes(dataroot, version, split, scenes), options.sensor_files(detections or [])
    if save is not None:
        options.apart(save, result, *files.values(), option="--save")
    _show(result, save, lambda: nuscenes_view(result, dataroot, version, chosen, files, spacing))


@view_app.command()
def kitti(
    result: Annotated[Path, typer.Argument(help="Folder of results NNNN.txt, of any tracker.")],
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/, label_02/ ...")],
    sequences: options.ResultSequences = None,
    detections: options.SeenFolder = None,
    slam: Annotated[
        Path | None, typer.Option("--slam", help="Folder that `saga-fg slam kitti` wrote, of the only sequence.")
    ] = None,
    spacing: Spacing = 0.1,
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See KITTI tracking results, with the labels, the scans of velodyne/ if it is there, and a map with landmarks.

    \b
    Example:
      saga-fg view kitti results --dataroot data/kitti --sequences 0000 --slam slam --save drive.rrd
    """
    from pipelines.view.sources import kitti_view

    chosen = options.names("--sequences", sequences) if sequences is not None else None
    _show(result, save, lambda: kitti_view(result, dataroot, chosen, detections, spacing), slam)


@view_app.command()
def file(
    result: Annotated[Path, typer.Argument(help="Table of tracks: .csv, .ndjson or .jsonl.")],
    detections: options.SeenTable = None,
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See a table of tracks.

    \b
    Example:
      saga-fg view file tracks.csv --detections detections.csv
    """
    from pipelines.view.sources import table_view

    if save is not None:
        options.apart(save, result, *([detections] if detections is not None else []), option="--save")
    _show(result, save, lambda: table_view(result, detections))


@view_app.command()
def slam(
    result: Annotated[Path, typer.Argument(help="Folder that `saga-fg slam kitti`, `victoria-park` or `plaza` wrote.")],
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See a run of SLAM: the paths, the map, the landmarks.

    \b
    Example:
      saga-fg view slam slam --save map.rrd
    """
    _show(result, save, list, result)


def _show(result: Path, save: Path | None, make: Callable[[], Sequence[SceneView]], slam: Path | None = None) -> None:
    """Write or open the scenes that `make` gives, with the map of a run of SLAM."""
    from pipelines.explaining import journal_of, read_graphs
    from pipelines.view import (
        check_view_file,
        draw_scene,
        draw_slam,
        in_order,
        load_rerun,
        read_slam_view,
        show_rerun,
        write_view,
    )
    from saga_fg.errors import InputError

    if save is None:
        load_rerun()
    else:
        check_view_file(save)
    with working("making the view"):
        graphs = read_graphs(journal_of(result)) if journal_of(result).exists() else {}
        scenes = [replace(each, graphs=graphs.get(each.report.scene.name, ())) for each in make()]
        driven = read_slam_view(slam) if slam is not None else None
        roots = [each.report.scene.name for each in scenes]
        if driven is not None and len(scenes) > 1:
            raise InputError(f"--slam {slam}: expected one sequence, got {', '.join(roots)}; choose it by --sequences")
        drawings = [draw_scene(each) for each in scenes]
        if driven is not None:
            root = f"{roots[0]}/slam" if roots else "slam"
            origin = scenes[0].report.scene.world_T_ego[0, :3, 3] if scenes else None
            drawings.append(draw_slam(driven, root, origin))
        roots = roots or ["slam"]
        if save is None:
            show_rerun(result.name, roots, in_order(*drawings))
        else:
            write_view(save, result.name, roots, in_order(*drawings))
    if save is not None:
        how = f"open it with: rerun {save}" if save.suffix == ".rrd" else "open it in Foxglove"
        typer.echo(f"{save}: {save.stat().st_size / 1e6:.1f} MB; {how}")
