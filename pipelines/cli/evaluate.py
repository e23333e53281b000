"""`saga-fg evaluate`: how good are tracks?"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Protocol, TypeVar

import typer

from pipelines.cli import options
from pipelines.cli.reporting import ReportingGroup, progress_bar, working
from pipelines.cli.tables import JsonFile, show_tables
from pipelines.cli.tracking_options import AssociationOption, EstimatorOption, LagOption, MethodOption, configured
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from data_tools.figures import FigureTable
    from pipelines.evaluation import KittiEvaluation, NuScenesEvaluation
    from saga_fg.numerics.arrays import FloatArray

evaluate_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

Hota = Annotated[bool, typer.Option("--hota", help="HOTA, CLEAR and Identity too (needs the extra [eval]).")]


Innovations = Annotated[
    bool, typer.Option("--innovations", help="How well innovations fit (NIS), from the journal beside the result.")
]
Plots = Annotated[
    Path | None,
    typer.Option("--plots", help="Folder to draw recall sweeps, calibration and errors to.", metavar="DIR"),
]


class Evaluation(Protocol):
    """What an evaluation gives."""

    def tables(self) -> list[FigureTable]: ...
    def figures(self) -> dict[str, object]: ...


class Drawn(Evaluation, Protocol):
    """One that can be drawn as well."""

    def pictures(self) -> dict[str, object]: ...


AnyEvaluation = TypeVar("AnyEvaluation", bound=Evaluation)


@evaluate_app.callback()
def evaluate() -> None:
    """Compare results with the ground truth."""


@evaluate_app.command()
def nuscenes(
    result: options.TrackingResult,
    dataroot: options.Tables,
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    detections: Annotated[
        list[str] | None,
        typer.Option(
            "--detections",
            help="Detections the tracks were made of: judge errors on the labels they match.",
            metavar="NAME=FILE",
        ),
    ] = None,
    hota: Hota = False,
    innovations: Innovations = False,
    json_file: JsonFile = None,
    plots: Plots = None,
    verbose: options.Verbose = False,
) -> None:
    """Score a nuScenes tracking result, by the official metrics and at its labels.

    The official figures equal those of the development kit, which need not be installed.

    \b
    Examples:
      saga-fg evaluate nuscenes tracks.json --dataroot data/nuscenes --split mini_train
      saga-fg evaluate nuscenes tracks.json --dataroot data/nuscenes --split mini_train \\
          --detections lidar=megvii.json --hota --json figures.json
    """
    from data_tools.datasets.nuscenes import read_scored_scenes
    from pipelines.evaluation import evaluate_nuscenes

    chosen = options.chosen_scenes(dataroot, version, split, scenes)
    files = options.sensor_files(detections or [])

    def run() -> NuScenesEvaluation:
        scored = read_scored_scenes(result, dataroot, version, chosen, files)
        return evaluate_nuscenes(scored, hota, _innovations_of(result) if innovations else None)

    _draw(_report(run, json_file), plots)


@evaluate_app.command()
def kitti(
    result: Annotated[Path, typer.Argument(help="Folder of results NNNN.txt, of any tracker.")],
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/, label_02/ ...")],
    sequences: options.ResultSequences = None,
    iou: Annotated[str, typer.Option("--iou", help="Least 3D overlaps of a pair, with commas.")] = "0.25,0.5,0.7",
    classes: Annotated[str, typer.Option("--classes", help="Classes, with commas.")] = "car,pedestrian,cyclist",
    detections: Annotated[
        Path | None,
        typer.Option(
            "--detections", help="Folder of the detections the tracks were made of: judge errors on what they match."
        ),
    ] = None,
    hota: Hota = False,
    innovations: Innovations = False,
    json_file: JsonFile = None,
    plots: Plots = None,
    verbose: options.Verbose = False,
) -> None:
    """Score KITTI tracking results by the 3D metrics averaged over recall, and at their labels.

    Velocities and covariances come from the table tracks.csv beside the results, which `saga-fg track kitti` writes.

    \b
    Examples:
      saga-fg evaluate kitti results --dataroot data/kitti
      saga-fg evaluate kitti results --dataroot data/kitti --sequences 0000,0011 --iou 0.5 \\
          --detections data/kitti/detections/pointrcnn --hota --json figures.json
    """
    from data_tools.datasets.kitti.scored_sequences import read_scored_sequences
    from pipelines.evaluation import evaluate_kitti

    chosen = options.names("--sequences", sequences) if sequences is not None else None
    overlaps, labels = _overlaps(iou), options.names("--classes", classes)

    def run() -> KittiEvaluation:
        scored = read_scored_sequences(result, dataroot, chosen, detections)
        return evaluate_kitti(scored, labels, overlaps, hota, _innovations_of(result) if innovations else None)

    _draw(_report(run, json_file), plots)


@evaluate_app.command()
def simulated(
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    method: MethodOption = "saga",
    estimator: EstimatorOption = None,
    lag: LagOption = None,
    association: AssociationOption = None,
    config: options.Config = None,
    simulator: options.Simulator = None,
    json_file: JsonFile = None,
    plots: Plots = None,
    verbose: options.Verbose = False,
) -> None:
    """Track simulated traffic and score it against the simulator's truth, hidden objects included.

    \b
    Examples:
      saga-fg evaluate simulated --scenes 4 --seed 0
      saga-fg evaluate simulated --method kf --config mine.yaml --json figures.json
    """
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from pipelines.configuration import load_settings
    from pipelines.evaluation import evaluate_simulated

    settings = configured("simulated", config, method, estimator, lag, association)
    traffic = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    dataset = SimulatedTraffic(traffic, scenes, seed)
    new_tracker = partial(settings.new_tracker, method)
    with progress_bar(scenes) as progress:
        evaluation = _report(lambda: evaluate_simulated(dataset, new_tracker, progress), json_file, "")
    _draw(evaluation, plots)


@evaluate_app.command()
def labels(
    result: Annotated[Path, typer.Argument(help="Folder that `saga-fg smooth` wrote, or its table of boxes.")],
    nuscenes_root: Annotated[
        Path | None, typer.Option("--nuscenes", help="The recordings are nuScenes scenes under this folder.")
    ] = None,
    kitti_root: Annotated[
        Path | None, typer.Option("--kitti", help="The recordings are KITTI sequences under this folder.")
    ] = None,
    file: Annotated[Path | None, typer.Option("--file", help="The recordings are this table of detections.")] = None,
    seed: Annotated[
        int | None, typer.Option("--simulated", min=0, help="The recordings are simulated traffic of this seed.")
    ] = None,
    detections: Annotated[
        list[str] | None,
        typer.Option("--detections", help="The detections, as for `saga-fg smooth`.", metavar="NAME=FILE"),
    ] = None,
    version: Annotated[str, typer.Option("--version", help="nuScenes: name of the folder of tables.")] = "v1.0-mini",
    simulator: Annotated[
        Path | None, typer.Option("--simulator", help="Simulated traffic: settings it was made with.", metavar="FILE")
    ] = None,
    without_truth: Annotated[
        bool, typer.Option("--without-truth", help="Self-consistency only, as where nobody has labelled.")
    ] = False,
    method: MethodOption = "saga",
    config: options.Config = None,
    json_file: JsonFile = None,
    verbose: options.Verbose = False,
) -> None:
    """Judge labels beside the online tracks and the detections: recall, errors on the same boxes, calibration.

    The scenes judged are those in the table. Where there is no ground truth, as in a file of one's own: how smooth the
    labels are and how well they agree with the detections.

    \b
    Examples:
      saga-fg evaluate labels labels --nuscenes data/nuscenes --detections lidar=megvii.json
      saga-fg evaluate labels labels --kitti data/kitti --detections data/kitti/detections/pointrcnn
      saga-fg evaluate labels labels --simulated 0 --json figures.json
      saga-fg evaluate labels labels --file detections.csv
    """
    from pipelines.cli.labelled_recordings import labelled_recordings
    from pipelines.evaluation import evaluate_labels
    from pipelines.smoothing import load_smooth_config

    found = labelled_recordings(
        result, nuscenes_root, version, kitti_root, file, seed, simulator, detections or [], not without_truth
    )
    settings = load_smooth_config(found.family, config)
    with progress_bar(len(found.dataset.scenes)) as progress:
        _report(lambda: evaluate_labels(found.table, found.dataset, settings, method, progress), json_file, "")


def _report(run: Callable[[], AnyEvaluation], json_file: Path | None, doing: str = "scoring") -> AnyEvaluation:
    """Run an evaluation, show its tables, write its figures."""
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable

    if json_file is not None:
        check_writable(json_file)
    with working(doing):
        evaluation = run()
    show_tables(evaluation.tables())
    if json_file is not None:
        write_figures(json_file, evaluation.figures())
    return evaluation


def _innovations_of(result: Path) -> dict[str, FloatArray]:
    """Those of the journal beside the result, by class."""
    from data_tools.evaluation.innovations import journal_innovations
    from pipelines.explaining import journal_of

    return journal_innovations(journal_of(result))


def _draw(evaluation: Drawn, plots: Path | None) -> None:
    """Write the pictures of an evaluation, if they are wanted."""
    from data_tools.files.atomic_files import atomic_directory
    from data_tools.plots import png

    if plots is not None:
        with atomic_directory(plots) as folder:
            for name, picture in evaluation.pictures().items():
                (folder / f"{name}.png").write_bytes(png(picture))


def _overlaps(text: str) -> tuple[float, ...]:
    try:
        overlaps = tuple(float(value) for value in options.names("--iou", text))
    except ValueError:
        raise InputError(f"--iou: expected numbers with commas between them, got {text!r}") from None
    if not all(0 < value <= 1 for value in overlaps):
        raise InputError(f"--iou: expected overlaps above 0 and at most 1, got {text!r}")
    return overlaps
