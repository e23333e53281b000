"""`saga-fg learn`: settings from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli import options
from pipelines.cli.reporting import ReportingGroup, progress_bar
from pipelines.cli.summary import counted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipelines.config import TrackConfig
    from saga_fg.types.dataset import Dataset

learn_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)
noise_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
learn_app.add_typer(noise_app, name="noise")

Output = Annotated[Path, typer.Option("--output", "-o", help="YAML file to write, for `saga-fg track --config`.")]
Blind = Annotated[
    bool, typer.Option("--without-truth", help="Leave the annotations alone: the tracker says what belongs together.")
]


@learn_app.callback()
def learn() -> None:
    """Learn settings from recordings."""


@learn_app.command()
def interactions(
    data: Annotated[
        str,
        typer.Option(
            "--data",
            help="Recordings: kitti=, nuscenes=, eth_ucy=, argoverse= with their folder, simulated= with a number of "
            "scenes, file= with a table of detections.",
            metavar="KIND=PLACE",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="YAML file to write, for `--interactions`.")],
    recordings: Annotated[
        str | None, typer.Option("--recordings", help="Recordings with commas between them; all if left out.")
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option("--detections", help="Learn from a tracker's view of these detections, not from the truth."),
    ] = None,
    network: Annotated[
        bool, typer.Option("--network", help="Train networks with JAX (extra [learn]) in place of kernels.")
    ] = False,
    verbose: options.Verbose = False,
) -> None:
    """Learn who follows whom, how strongly, and what noise is left: edge rules for `saga-fg track --interactions`.

    Objects are hidden for up to 3 s while their neighbours stay in view; learned is what makes the places at which they
    reappear most likely.

    \b
    Examples:
      saga-fg learn interactions --data kitti=data/kitti --recordings 0000,0011,0020 --output interactions.yaml
      saga-fg learn interactions --data file=detections.csv --output interactions.yaml
      saga-fg track file detections.csv --interactions interactions.yaml --output tracks.csv
    """
    from data_tools.files.atomic_files import check_writable, write_text
    from pipelines.configuration import write_settings
    from pipelines.learning import TrajectorySource, learn_interactions

    check_writable(output)
    chosen = options.names("--recordings", recordings) if recordings is not None else None
    source = TrajectorySource.parsed(data, chosen, detections)
    options.apart(output, *source.files)
    found = source.trajectories()
    told = "tracks" if detections is not None or source.kind == "file" else "trajectories"
    origin = f"{told} of {counted(len(found), 'recording')}, {source.kind}: {', '.join(found)}"
    with progress_bar(unit="recordings") as progress:
        learned = learn_interactions(found, origin, network, progress)
    write_text(output, write_settings(learned))
    why = "" if learned.edges else "; no interaction that was tried lowered errors on what was held out"
    typer.echo(f"{output}: {counted(len(learned.edges), 'edge rule')} learned from {origin}{why}")


@noise_app.callback()
def noise() -> None:
    """Learn what sensors are like, and how objects move, from recordings.

    For each sensor and class: noise of positions (base, along and across the line of sight), velocities, headings and
    heights, what a score is worth, the chance of detection, the field of view; for each class its process noise. Where
    there is ground truth, it is used; where there is none, the tracker's own tracks take its place.
    """


@noise_app.command()
def nuscenes(
    dataroot: options.Tables,
    detections: options.SensorDetections,
    output: Output,
    version: options.Version = "v1.0-mini",
    split: options.Split = None,
    scenes: options.SceneNames = None,
    without_truth: Blind = False,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn from nuScenes detections.

    \b
    Example:
      saga-fg learn noise nuscenes --dataroot data/nuscenes --scenes scene-0061,scene-0553 \\
          --detections lidar=a.json --detections camera=b.json --output noise.yaml
      saga-fg track nuscenes --dataroot data/nuscenes --scenes scene-0103 --config noise.yaml \\
          --detections lidar=a.json --detections camera=b.json --output tracks.json
    """
    from data_tools.datasets.nuscenes import NuScenes
    from pipelines.config import load_config

    chosen = options.chosen_scenes(dataroot, version, split, scenes)
    files = options.sensor_files(detections)
    options.apart(output, *files.values())
    settings = load_config("nuscenes", config)
    dataset = NuScenes(dataroot, version, files, chosen, ground_truth=not without_truth)
    _learn(dataset, chosen, settings, not without_truth, output)


@noise_app.command()
def kitti(
    dataroot: Annotated[Path, typer.Option("--dataroot", help="Folder that holds training/, or oxts/ and calib/.")],
    detections: Annotated[
        Path, typer.Option("--detections", help="Folder with Car/, Pedestrian/, Cyclist/ and in each NNNN.txt.")
    ],
    output: Output,
    sequences: options.Sequences = None,
    without_truth: Blind = False,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn from KITTI detections.

    \b
    Example:
      saga-fg learn noise kitti --dataroot data/kitti --detections data/kitti/detections/pointrcnn \\
          --sequences 0000,0002 --output noise.yaml
    """
    from data_tools.datasets.kitti import KittiTracking
    from pipelines.config import load_config

    settings = load_config("kitti", config)
    chosen = options.names("--sequences", sequences) if sequences is not None else None
    dataset = KittiTracking(dataroot, detections, chosen, ground_truth=not without_truth)
    _learn(dataset, dataset.scenes, settings, not without_truth, output)


@noise_app.command()
def simulated(
    output: Output,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same scenes.")] = 0,
    simulator: options.Simulator = None,
    without_truth: Blind = False,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn from simulated traffic, of which the noise is known.

    \b
    Example:
      saga-fg learn noise simulated --scenes 2 --without-truth --output noise.yaml
    """
    from data_tools.simulator import SimulatedTraffic, SimulatorSettings
    from pipelines.config import load_config
    from pipelines.configuration import load_settings

    settings = load_config("simulated", config)
    world = load_settings(SimulatorSettings, simulator) if simulator is not None else SimulatorSettings()
    dataset = SimulatedTraffic(world, scenes, seed)
    _learn(dataset, dataset.scenes, settings, not without_truth, output)


@noise_app.command()
def file(
    detections: Annotated[Path, typer.Argument(help="Table of detections: .csv, .ndjson, .jsonl or .npz.")],
    output: Output,
    scenes: options.SceneNames = None,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn from your own detections, without ground truth.

    \b
    Example:
      saga-fg learn noise file detections.csv --output noise.yaml
      saga-fg track file detections.csv --config noise.yaml --output tracks.csv
    """
    from data_tools.datasets.detection_files import read_detections
    from pipelines.config import load_config

    settings = load_config("file", config)
    options.apart(output, detections)
    dataset = read_detections(detections)
    chosen = dataset.scenes if scenes is None else options.names("--scenes", scenes)
    _learn(dataset, chosen, settings, False, output)


def _learn(dataset: Dataset, scenes: Sequence[str], config: TrackConfig, with_truth: bool, output: Path) -> None:
    from data_tools.files.atomic_files import check_writable, write_text
    from pipelines.learning import learn_noise, learned_fragment

    check_writable(output)
    with progress_bar(unit="scenes") as progress:
        learned = learn_noise(dataset, scenes, config, with_truth, progress)
    truth = "with ground truth" if with_truth else "without ground truth"
    write_text(output, learned_fragment(learned, f"{counted(len(scenes), 'scene')} {truth}"))
    found = ", ".join(f"{name} {counted(n, 'detection')}" for name, n in learned.detections.items())
    typer.echo(f"{output}: learned from {counted(len(scenes), 'scene')} {truth}: {found}")
