"""`saga-fg report` and `saga-fg view`: results to look at."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from data_tools.datasets.source import DatasetSource, input_files
from data_tools.files import check_writable, write_text
from pipelines import view
from pipelines.cli import options
from pipelines.cli.console import working
from pipelines.cli.options import dataset_commands
from pipelines.explaining import journal_of, read_graphs
from pipelines.report import drive_page, report_page, result_report
from saga_fg.errors import InputError


def _report(
    source: DatasetSource,
    result: options.Result,
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")],
    beside: Annotated[
        Path | None,
        typer.Option("--beside", help="Another result of the same recordings, to show side by side.", metavar="RESULT"),
    ] = None,
    images: Annotated[
        int, typer.Option("--images", min=0, help="Width of the camera images in the page, pixels; 0 leaves them out.")
    ] = 240,
    verbose: options.Verbose = False,
) -> None:
    """Make a page of a tracking result: a player, charts, and figures, of errors where there is ground truth."""
    options.apart(output, result, *([] if beside is None else [beside]), *input_files(source))
    _write_page(output, lambda: report_page(result_report(source, result, beside, images)))


def _write_page(output: Path, make: Callable[[], str]) -> None:
    if output.suffix not in (".html", ".htm"):
        raise InputError(f"{output}: expected a file name that ends in .html")
    check_writable(output)
    with working("making the page"):
        page = make()
        write_text(output, page)
    typer.echo(f"{output}: {len(page) / 1e6:.1f} MB")


report_app = dataset_commands(
    "report",
    "Make a page of a result: a player, figures, charts; one HTML file that needs no network.",
    _report,
    ("report {result} --output report.html", "report {result} --beside other/{tracks} --output report.html"),
    lambda source: {} if "images" in source.shows else {"images": None},
)


@report_app.command("slam")
def report_slam(
    result: Annotated[Path, typer.Argument(help="Folder that `saga-fg slam scans` wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML file to write.")],
    verbose: options.Verbose = False,
) -> None:
    """Make a page of a run of SLAM: path over map, drift along the way, errors, loops, open motions.

    \b
    Example:
      saga-fg report slam slam --output drive.html
    """
    _write_page(output, lambda: drive_page(result))


Save = Annotated[
    Path | None,
    typer.Option(
        "--save",
        help="Write a file instead of opening the viewer: .rrd for rerun, .mcap for Foxglove (extra [mcap]).",
        metavar="FILE",
    ),
]


def _view(
    source: DatasetSource,
    result: options.Result,
    slam: Annotated[
        Path | None,
        typer.Option("--slam", help="Folder that `saga-fg slam` wrote, of the only scene.", metavar="FOLDER"),
    ] = None,
    spacing: Annotated[
        float, typer.Option("--spacing", min=0.0, help="Thin the LiDAR's points to this, m; 0 leaves them out.")
    ] = 0.1,
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See a tracking result, with the ground truth, the detections and the LiDAR scans where they are there."""
    if save is not None:
        options.apart(save, result, *input_files(source), option="--save")
    _show(result, save, lambda: view.result_views(source, result, spacing), slam)


view_app = dataset_commands(
    "view",
    "See a result in space: boxes, tracks, ellipses, edges, graph, truth, LiDAR, landmarks (rerun or Foxglove).",
    _view,
    ("view {result}", "view {result} --save tracks.mcap"),
    lambda source: {} if "scans" in source.shows else {"spacing": None},
)


@view_app.command()
def slam(
    result: Annotated[Path, typer.Argument(help="Folder that `saga-fg slam scans` wrote.")],
    save: Save = None,
    verbose: options.Verbose = False,
) -> None:
    """See a run of SLAM: the paths, the map, the landmarks.

    \b
    Example:
      saga-fg view slam slam --save map.rrd
    """
    _show(result, save, list, result)


def _show(
    result: Path, save: Path | None, make: Callable[[], Sequence[view.SceneView]], slam: Path | None = None
) -> None:
    """Write or open the scenes that `make` gives, with the map of a run of SLAM."""
    if save is None:
        view.load_rerun()
    else:
        view.check_view_file(save)
    with working("making the view"):
        graphs = read_graphs(journal_of(result))
        scenes = [replace(each, graphs=graphs.get(each.report.scene.name, ())) for each in make()]
        driven = view.read_slam_view(slam) if slam is not None else None
        roots = [each.report.scene.name for each in scenes]
        if driven is not None and len(scenes) > 1:
            raise InputError(f"--slam {slam}: expected one sequence, got {', '.join(roots)}; choose one")
        drawings = [view.draw_scene(each) for each in scenes]
        if driven is not None:
            root = f"{roots[0]}/slam" if roots else "slam"
            origin = scenes[0].report.scene.world_T_ego[0, :3, 3] if scenes else None
            drawings.append(view.draw_slam(driven, root, origin))
        roots = roots or ["slam"]
        if save is None:
            view.RerunViewer(result.name, roots).draw(view.in_order(*drawings))
        else:
            view.write_view(save, result.name, roots, view.in_order(*drawings))
    if save is not None:
        how = f"open it with: rerun {save}" if save.suffix == ".rrd" else "open it in Foxglove"
        typer.echo(f"{save}: {save.stat().st_size / 1e6:.1f} MB; {how}")
