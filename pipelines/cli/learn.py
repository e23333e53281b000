"""`saga-fg learn`: settings from recordings."""

from pathlib import Path
from typing import Annotated, Any

import typer

from data_tools.datasets.source import DatasetSource, dataset_names, input_files
from data_tools.files import check_writable, write_text
from pipelines.cli import options
from pipelines.cli.console import JsonFile, MarkdownFile, ReportingGroup, counted, new_group, progress_bar, report
from pipelines.cli.options import dataset_commands
from pipelines.config import load_config, load_interactions
from pipelines.configuration import write_settings
from pipelines.learning import (
    learn_interactions,
    learn_noise,
    learned_figures,
    learned_fragment,
    learned_tables,
    scenes_to_learn_from,
)


def _interactions(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o", help="YAML file to write, for `--interactions`.")],
    config: options.Config = None,
    start: Annotated[
        Path | None,
        typer.Option(
            "--start",
            help="File of an earlier result: search from it, with the prior centred on it, and refit its rules only.",
            metavar="FILE",
        ),
    ] = None,
    passes: Annotated[
        int, typer.Option("--passes", min=1, help="Runs with made gaps over each recording that is held out.")
    ] = 2,
    json_file: JsonFile = None,
    markdown: MarkdownFile = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn who follows whom, and how strongly: edge rules for `saga-fg track --interactions`.

    Objects are hidden for up to 5 s while their neighbours stay in view; learned is what makes the places at which they
    reappear most likely. Which form of the edges is written is decided on recordings held out, whose gaps are shown: by
    the base motion alone, with the edges of the configuration and with learned ones. Truth is the ground truth or,
    where detections are given, the tracks of a tracker.
    """
    check_writable(output)
    options.apart(output, *input_files(source), *(() if start is None else (start,)))
    settings = load_config(source.family, config)
    begin = None if start is None else load_interactions(start)
    with_truth = source.has_truth and getattr(source, "detections", None) is None
    found = scenes_to_learn_from(source, settings, with_truth)
    learned_from = "ground truth" if with_truth else "tracks"
    origin = f"{learned_from} of {counted(len(found), 'recording')}, {source.name}: {', '.join(found)}"
    with progress_bar(unit="runs") as progress:
        learned = learn_interactions(found, origin, settings, begin, passes, progress)
    write_text(output, write_settings(learned.interactions))
    report(learned_tables(learned), learned_figures(learned), json_file, markdown)
    edges = learned.interactions.edges
    why = "" if edges else "; no form that was tried lowered errors on what was held out"
    typer.echo(f"{output}: {counted(len(edges), 'edge rule')} learned from {origin}{why}")


def _noise(
    source: DatasetSource,
    output: Annotated[Path, typer.Option("--output", "-o", help="YAML file to write, for `saga-fg track --config`.")],
    without_truth: Annotated[
        bool,
        typer.Option("--without-truth", help="Leave the annotations alone: the tracker says what belongs together."),
    ] = False,
    config: options.Config = None,
    verbose: options.Verbose = False,
) -> None:
    """Learn what sensors are like, and how objects move, from detections and, where there is some, ground truth."""
    options.apart(output, *input_files(source))
    settings = load_config(source.family, config)
    with_truth = source.has_truth and not without_truth
    with source.open(truth=with_truth) as dataset:
        check_writable(output)
        with progress_bar(unit="scenes") as progress:
            learned = learn_noise(dataset, dataset.scenes, settings, with_truth, progress)
        scenes = counted(len(dataset.scenes), "scene")
    truth = "with ground truth" if with_truth else "without ground truth"
    write_text(output, learned_fragment(learned, f"{scenes} {truth}"))
    found = ", ".join(f"{name} {counted(n, 'detection')}" for name, n in learned.detections.items())
    typer.echo(f"{output}: learned from {scenes} {truth}: {found}")


noise_app = dataset_commands(
    "learn noise",
    """Learn what sensors are like, and how objects move, from recordings.

    For each sensor and class: noise of positions (base, along and across the line of sight), velocities, headings and
    heights, what a score is worth, the chance of detection, the field of view. For each class: its process noise, and
    for curvilinear motion how fast accelerations and turns fade (fading_time, turn_time). Where there is ground truth,
    it is used; where there is none, the tracker's own tracks take its place.
    """,
    _noise,
    (
        "learn noise {recordings} --output noise.yaml",
        "track {recordings} --output {tracks} --config noise.yaml",
    ),
    lambda source: {} if source.has_truth else {"without_truth": None},
)
interactions_app = dataset_commands(
    "learn interactions",
    "Learn who follows whom, and how strongly: edge rules for a tracker.",
    _interactions,
    (
        "learn interactions {recordings} --output interactions.yaml",
        "track {recordings} --output {tracks} --interactions interactions.yaml",
    ),
)


class LearnGroup(ReportingGroup):
    """The kinds of settings that can be learned; names the command where a dataset is given in their place."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in dataset_names():
            ctx.fail(f"No such command '{args[0]}'; try 'learn noise {args[0]}' or 'learn interactions {args[0]}'.")
        return super().resolve_command(ctx, args)


learn_app = new_group("Learn settings from recordings.", LearnGroup)
learn_app.add_typer(noise_app, name="noise")
learn_app.add_typer(interactions_app, name="interactions")
