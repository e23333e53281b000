"""`saga-fg report`: a page to look at a result with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli.reporting import ReportingGroup, working

if TYPE_CHECKING:
    from pipelines.report import Report

report_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

Page = Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")]


@report_app.callback()
def report() -> None:
    """Make a page of a result: a player, figures, charts; one HTML file that needs no network."""


@report_app.command()
def nuscenes(
    result: options.TrackingResult,
    dataroot: options.Tables,
    output: Page,
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    detections: options.SeenBySensors = None,
    verbose: options.Verbose = False,
) -> None:
    """A page of a nuScenes tracking result, beside the ground truth.

    \b
    Example:
      saga-fg report nuscenes tracks.json --dataroot data/nuscenes --split mini_train \\
          --detections lidar=megvii.json --output report.html
    """
    from pipelines.report.sources import nuscenes_report

    chosen, files = options.chosen_scenes(dataroot, version, split, scenes), options.sensor_files(detections or [])
    options.apart(output, result, *files.values())
    _write(output, lambda: nuscenes_report(result, dataroot, version, chosen, files))


@report_app.command()
def kitti(
    result: Annotated[Path, typer.Argument(help="Folder of results NNNN.txt, of any tracker.")],
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/, label_02/ ...")],
    output: Page,
    sequences: options.ResultSequences = None,
    detections: options.SeenFolder = None,
    verbose: options.Verbose = False,
) -> None:
    """A page of KITTI tracking results, beside the labels.

    \b
    Example:
      saga-fg report kitti results --dataroot data/kitti --sequences 0000,0011 \\
          --detections data/kitti/detections/pointrcnn --output report.html
    """
    from pipelines.report.sources import kitti_report

    chosen = options.names("--sequences", sequences) if sequences is not None else None
    _write(output, lambda: kitti_report(result, dataroot, chosen, detections))


@report_app.command()
def file(
    result: Annotated[Path, typer.Argument(help="Table of tracks: .csv, .ndjson or .jsonl.")],
    output: Page,
    detections: options.SeenTable = None,
    verbose: options.Verbose = False,
) -> None:
    """A page of a table of tracks, without figures, since there is no ground truth.

    \b
    Example:
      saga-fg report file tracks.csv --detections detections.csv --output report.html
    """
    from pipelines.report.sources import table_report

    options.apart(output, result, *([detections] if detections is not None else []))
    _write(output, lambda: table_report(result, detections))


def _write(output: Path, make: Callable[[], Report]) -> None:
    from data_tools.files.atomic_files import check_writable, write_text
    from pipelines.report import report_page
    from saga_fg.errors import InputError

    if output.suffix not in (".html", ".htm"):
        raise InputError(f"{output}: expected a file name that ends in .html")
    check_writable(output)
    with working("making the page"):
        page = report_page(make())
        write_text(output, page)
    typer.echo(f"{output}: {len(page) / 1e6:.1f} MB")
