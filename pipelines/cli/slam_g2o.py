"""`saga-fg slam g2o`: the optimum of a pose graph from a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pipelines.cli.console import working
from pipelines.cli.options import Verbose
from pipelines.cli.summary import counted

if TYPE_CHECKING:
    from pipelines.slam.pose_graph_baselines import FromStart
    from saga_fg.numerics.arrays import IntArray

_ROUNDING = 1e-9  # an error that counts as none: all measurements agree
Loss = Literal["consensus", "huber", "cauchy", "geman-mcclure", "tukey"]


def g2o(
    file: Annotated[Path, typer.Argument(help="Pose graph in the g2o format, in the plane or in space.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    compare: Annotated[
        bool,
        typer.Option("--compare", help="Run GTSAM's Levenberg-Marquardt and iSAM2 (QR) too, with times."),
    ] = False,
    isam2_batch: Annotated[
        int | None,
        typer.Option("--isam2-batch", min=1, help="With --compare: poses that iSAM2 is given at once.  [default: 10]"),
    ] = None,
    certify: Annotated[
        bool,
        typer.Option("--certify", help="Find the global minimum of the chordal cost too, start from it, and prove it."),
    ] = False,
    covariances: Annotated[
        str,
        typer.Option(
            "--covariances", metavar="all|last|none|IDS", help="Poses in covariances.csv: IDS with commas between them."
        ),
    ] = "all",
    robust: Annotated[
        Loss | None,
        typer.Option(
            "--robust",
            help="Against false loops, measurements that do not join successive poses: leave out those that contradict "
            "the rest (consensus), or a loss over all of them.",
        ),
    ] = None,
    robust_scale: Annotated[
        float | None, typer.Option("--robust-scale", help="Scale of that loss, standard deviations.  [default: 3]")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Optimise a pose graph, whatever the guess in the file is worth.

    Writes the optimised graph (poses.g2o), covariances.csv, errors.json and a picture from above (above.png).

    \b
    Examples:
      saga-fg slam g2o sphere2500.g2o --output sphere
      saga-fg slam g2o MIT.g2o --output MIT --compare
      saga-fg slam g2o CSAIL.g2o --output CSAIL --certify --covariances last
      saga-fg slam g2o with_false_loops.g2o --robust consensus --output clean
    """
    from data_tools.files.atomic_files import check_writable_folder
    from data_tools.files.error_messages import error_context
    from data_tools.pose_graphs import read_g2o
    from factors import Robust
    from pipelines.slam.pose_graph_baselines import from_same_starts, isam2
    from pipelines.slam.results import write_pose_graph
    from saga_fg.errors import InputError
    from saga_fg.slam.pose_graph import consensus, graph_error, optimise_poses

    if robust not in (None, "consensus") and certify:
        raise InputError("--certify: expected without a robust loss, the proof is for squared errors")
    if robust not in (None, "consensus") and compare:
        raise InputError("--compare: expected without a robust loss, GTSAM's optimisers are run without one")
    scale = 3.0 if robust_scale is None else robust_scale
    if not 0 < scale < math.inf:
        raise InputError(f"--robust-scale {scale:g}: expected a number > 0")
    if robust in (None, "consensus") and robust_scale is not None:
        raise InputError("--robust-scale: expected with --robust and the name of a loss only")
    if not compare and isam2_batch is not None:
        raise InputError("--isam2-batch: expected with --compare only")
    check_writable_folder(output)
    rejected: list[str] = []
    compared: list[FromStart] = []
    loss = None if robust is None or robust == "consensus" else Robust(robust, scale)
    graph = read_g2o(file)
    rows = _rows(covariances, graph.ids)
    with working("optimising"), error_context(str(file)):  # a graph that is whole may have no optimum, as one in pieces
        guess = graph_error(graph, loss)
        if robust == "consensus":
            agreed = consensus(graph)
            rejected = [
                f"{graph.ids[graph.first[k]]} {graph.ids[graph.second[k]]}" for k in (~agreed.kept).nonzero()[0]
            ]
            graph = agreed.graph
        optimised = optimise_poses(graph, loss, certify)
        blocks = optimised.covariances(rows)
    errors = {"guess itself": guess, **{f"from the {name}": error for name, error in optimised.errors.items()}}
    if compare:
        with working("GTSAM's optimisers"):
            compared = from_same_starts(graph)
            for row in compared:
                errors[f"GTSAM Levenberg-Marquardt from the {row.start}"] = row.gtsam_error
            if graph.poses_alone:
                errors["GTSAM iSAM2 (QR)"] = isam2(graph, isam2_batch or 10)
    write_pose_graph(output, graph, optimised, rows, blocks, errors, rejected)
    poses, count = counted(len(graph), "pose"), len(graph.first)
    count += sum(len(one.pose) for one in (graph.priors, graph.places) if one is not None)
    if graph.landmarks is not None:
        poses += f", {counted(len(graph.landmarks.ids), 'landmark')}"
        count += sum(len(seen.pose) for seen in graph.landmarks.observations)
    typer.echo(
        f"{output}: {poses}, {counted(count, 'measurement')}, error {optimised.error:.6g} (at the start {guess:.6g})"
    )
    if robust == "consensus":
        typer.echo(f"left out as false: {counted(len(rejected), 'loop')}")
    if (minimum := optimised.chordal) is not None:
        proven = "the global minimum" if minimum.certified else "not proven to be the global minimum"
        typer.echo(f"chordal cost {minimum.cost:.8g}, {proven}: no poses below {minimum.bound:.8g}")
    for name, error in errors.items():
        if name.startswith("GTSAM"):
            least = max(error, optimised.error)  # a graph that all measurements agree on is met but for rounding
            ours = (
                "both 0" if least < _ROUNDING else f"ours is {optimised.error / max(error, _ROUNDING):.4f} times that"
            )
            typer.echo(f"{name}: error {error:.6g}, {ours}")
    for row in compared:
        typer.echo(
            f"CPU time from the {row.start}: {row.seconds:.2f} s, {row.seconds / row.gtsam_seconds:.2f} times that of "
            f"GTSAM Levenberg-Marquardt (error {row.error:.6g}, {row.gtsam_error:.6g})"
        )


def _rows(chosen: str, ids: IntArray) -> IntArray:
    """Rows of the poses whose covariances are wanted."""
    import numpy as np

    from saga_fg.errors import InputError

    if chosen in ("all", "last", "none"):
        return {"all": np.arange(len(ids)), "last": np.array([len(ids) - 1]), "none": np.arange(0)}[chosen]
    known = {str(name): row for row, name in enumerate(ids.tolist())}
    names = list(dict.fromkeys(name.strip() for name in chosen.split(",")))
    for name in names:
        if name in ("all", "last", "none"):
            raise InputError(f"--covariances: expected {name} alone or ids of poses with commas, got {chosen!r:.40}")
        if name not in known:
            raise InputError(f"--covariances: expected all, last, none or ids of poses with commas, got {name!r:.40}")
    return np.array([known[name] for name in names])
