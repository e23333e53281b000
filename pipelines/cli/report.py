"""`saga-fg report`: a page to look at a result with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.options import (
    SceneNames,
    Split,
    Tables,
    TrackingResult,
    Verbose,
    Version,
    apart,
    chosen_scenes,
    names,
    sensor_files,
)
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
    result: TrackingResult,
    dataroot: Tables,
    output: Page,
    version: Version = "v1.0-mini",
    split: Split = None,
    scenes: SceneNames = None,
    detections: Annotated[
        list[str] | None,
        typer.Option("--detections", help="Detections the tracks were made of, to see them too.", metavar="NAME=FILE"),
    ] = None,
    verbose: Verbose = False,
) -> None:
    """A page of a nuScenes tracking result, beside the ground truth.

    \b
    Example:
      saga-fg report nuscenes tracks.json --dataroot data/nuscenes --split mini_train \\
          --detections lidar=megvii.json --output report.html
    """
    from pipelines.report.sources import nuscenes_report

    chosen, files = chosen_scenes(dataroot, version, split, scenes), sensor_files(detections or [])
    apart(output, result, *files.values())
    _write(output, lambda: nuscenes_report(result, dataroot, version, chosen, files))


@report_app.command()
def kitti(
    result: Annotated[Path, typer.Argument(help="Folder of results NNNN.txt, of any tracker.")],
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/, label_02/ ...")],
    output: Page,
    sequences: Annotated[
        str | None, typer.Option("--sequences", help="Sequences with commas between them; all results if left out.")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option("--detections", help="Folder of the detections the tracks were made of.")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """A page of KITTI tracking results, beside the labels.

    \b
    Example:
      saga-fg report kitti results --dataroot data/kitti --sequences 0000,0011 \\
          --detections data/kitti/detections/pointrcnn --output report.html
    """
    from pipelines.report.sources import kitti_report

    chosen = names("--sequences", sequences) if sequences is not None else None
    _write(output, lambda: kitti_report(result, dataroot, chosen, detections))


@report_app.command()
def file(
    result: Annotated[Path, typer.Argument(help="Table of tracks: .csv, .ndjson or .jsonl.")],
    output: Page,
    detections: Annotated[
        Path | None, typer.Option("--detections", help="Table of the detections the tracks were made of.")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """A page of a table of tracks, without figures, since there is no ground truth.

    \b
    Example:
      saga-fg report file tracks.csv --detections detections.csv --output report.html
    """
    from pipelines.report.sources import table_report

    apart(output, result, *([detections] if detections is not None else []))
    _write(output, lambda: table_report(result, detections))


def _write(output: Path, make: Callable[[], Report]) -> None:
    from data_tools.atomic_files import check_writable, write_text
    from pipelines.report import report_page
    from saga_fg.errors import InputError

    if output.suffix not in (".html", ".htm"):
        raise InputError(f"{output}: expected a file name that ends in .html")
    check_writable(output)
    with working("making the page"):
        page = report_page(make())
        write_text(output, page)
    typer.echo(f"{output}: {len(page) / 1e6:.1f} MB")
