"""The options that say how to track, shared by all commands that do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from saga_fg.errors import InputError
from saga_fg.tracking import AssociationName

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pipelines.config import Method, TrackConfig
    from saga_fg.numerics.arrays import FloatArray
    from saga_fg.tracking import SensorTime

_METHOD = typer.Option(
    "--method",
    help="saga: graph-aware Kalman filter; kf: without edges, trails and lanes; centerpoint: greedy nearest centre.",
)
MethodOption = Annotated[Literal["saga", "kf", "centerpoint"], _METHOD]
MethodOrNone = Annotated[Literal["saga", "kf", "centerpoint"] | None, _METHOD]

EstimatorOption = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        help="kalman: fastest; isam2: the same filter as a factor graph of one epoch; fixed-lag: a factor graph of "
        "the last --lag seconds, which puts late frames where they belong; MODULE:NAME, which is imported, or the name "
        "of an installed entry point: your own. The bounds of kalman (tracker.tolerance, "
        "tracker.max_component) move tracks by millimetres, a centimetre at most in our recordings.  "
        "[default: as configured]",
        metavar="NAME",
    ),
]
LagOption = Annotated[
    float | None,
    typer.Option("--lag", min=0.0, help="Window of the fixed-lag estimator, s.  [default: as configured]"),
]
AssociationOption = Annotated[
    AssociationName | None,
    typer.Option(
        "--association",
        help="How detections are matched to tracks. hungarian: least total cost; greedy: the cheapest pair first; "
        "graph: relative positions count as well.  [default: as configured]",
    ),
]
InteractionsOption = Annotated[
    Path | None,
    typer.Option("--interactions", help="Edge rules from `saga-fg learn interactions`.", metavar="FILE"),
]
ExplainOption = Annotated[
    bool,
    typer.Option("--explain", help="Keep a journal beside the output, for `saga-fg explain`: OUTPUT.journal.jsonl."),
]
LearnOffsetsOption = Annotated[
    Path | None,
    typer.Option(
        "--learn-offsets",
        help="YAML file to write: the offsets of the sensors' clocks, from objects that several of them see, for "
        "`--config`.",
        metavar="FILE",
    ),
]
PredictOption = Annotated[
    str | None,
    typer.Option(
        "--predict",
        help="Predict the tracks of every moment to these s after it, and keep that beside the output: "
        "OUTPUT.predictions.csv, for `saga-fg report`.",
        metavar="S,S,...",
    ),
]


def configured(
    family: str | Path,
    config: Path | None,
    method: Method,
    estimator: str | None,
    lag: float | None,
    association: AssociationName | None = None,
    interactions: Path | None = None,
) -> TrackConfig:
    """The settings of a run: the family's, the file's, then the options'."""
    from pipelines.config import load_config

    settings = with_interactions(load_config(family, config), method, interactions)
    _estimator_fits(method, estimator, lag, settings.tracker.estimator)
    association_fits(method, association)
    return settings.with_estimator(estimator, lag).with_association(association)


def association_fits(method: str, association: str | None) -> None:
    """Raise `InputError` where --association would have no effect."""
    if method == "centerpoint" and association is not None:
        raise InputError("--association: the method centerpoint has its own")


def with_interactions(config: TrackConfig, method: str, interactions: Path | None) -> TrackConfig:
    """The configuration with learned edge rules, if a file of them is given; it has an effect on saga alone."""
    from pipelines.config import load_interactions

    if interactions is None:
        return config
    if method != "saga":
        raise InputError(f"--interactions {interactions}: goes with --method saga, {method} has no interactions")
    return config.with_interactions(load_interactions(interactions))


def horizons(predict: str | None, method: Method) -> FloatArray | None:
    """The horizons (H,) of --predict, s; None if it is left out. Raises `InputError` for anything else."""
    from saga_fg.types.predicted_tracks import checked_horizons

    if predict is None:
        return None
    if method == "centerpoint":
        raise InputError("--predict: expected --method saga or kf, centerpoint predicts nothing")
    try:
        return checked_horizons([float(text) for text in predict.split(",")])
    except InputError as error:
        raise InputError(f"--predict: {error}") from error
    except ValueError as error:
        raise InputError(f"--predict: expected seconds with commas between them, got {predict[:40]!r}") from error


def _estimator_fits(method: str, estimator: str | None, lag: float | None, configured: str) -> None:
    """Raise `InputError` where --estimator or --lag would have no effect."""
    from saga_fg.tracking.by_name import estimator_parameters

    if method == "centerpoint" and (estimator is not None or lag is not None):
        raise InputError("--estimator, --lag: the method centerpoint has no estimator")
    if lag is not None and "lag" not in estimator_parameters(estimator or configured):
        raise InputError(f"--lag {lag:g}: goes with --estimator fixed-lag")


def journal(explain: bool, output: Path, at_scale: bool) -> Path | None:
    """Path of the journal, None if none is wanted. Raises `InputError` where none can be kept."""
    from pipelines.explaining import journal_of

    if explain and at_scale:
        raise InputError("--explain: goes without --workers and --ray")
    return journal_of(output) if explain else None


def check_learn_offsets(path: Path | None, method: str, at_scale: bool = False) -> None:
    """Raise `InputError` where --learn-offsets would have no effect, or its file is not writable."""
    from data_tools.files.atomic_files import check_writable

    if path is None:
        return
    if method == "centerpoint":
        raise InputError("--learn-offsets: expected --method saga or kf")
    if at_scale:
        raise InputError("--learn-offsets: goes without --workers and --ray")
    check_writable(path)


def write_offsets(path: Path, scenes: Iterable[Mapping[str, SensorTime]], settings: TrackConfig, origin: str) -> None:
    """Write the file of --learn-offsets, and say what is in it."""
    from data_tools.files.atomic_files import write_text
    from pipelines.learning import offset_fragment

    text, offsets = offset_fragment(scenes, settings.sensors, origin)
    write_text(path, text)
    found = ", ".join(f"{name} {offset:+.4f} s" for name, offset in offsets.items())
    typer.echo(f"{path}: {found or 'no two sensors have moving objects in common'}", err=True)
