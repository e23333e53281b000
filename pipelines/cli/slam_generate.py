"""`saga-fg slam generate`: pose graphs of known truth, of any size."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.summary import counted


class Shape(StrEnum):
    """Shape of the simulated drive."""

    CITY = "city"
    TORUS = "torus"
    SPHERE = "sphere"
    GRID = "grid"
    CUBE = "cube"


def generate(
    shape: Annotated[Shape, typer.Argument(help="city, grid: in the plane; torus, sphere, cube: in space.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="g2o file to write.")],
    poses: Annotated[int, typer.Option("--poses", min=2, help="Number of poses.")] = 10000,
    noise: Annotated[float, typer.Option("--noise", help="Standard deviation of a measurement, m.")] = 0.05,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed makes the same graph.")] = 0,
    verbose: Verbose = False,
) -> None:
    """Make a pose graph with loop closures, whose guess is dead reckoning.

    \b
    Example:
      saga-fg slam generate city --poses 10000 --output city.g2o
      saga-fg slam g2o city.g2o --output city --compare
    """
    from data_tools import pose_graphs
    from saga_fg.errors import InputError

    try:
        graph, _ = getattr(pose_graphs, shape.value)(poses, seed, noise=noise)
    except InputError as error:
        raise InputError(f"--{error}") from None
    pose_graphs.write_g2o(output, graph)
    residuals, free = graph.information.shape[1] * len(graph.first), graph.information.shape[1] * (len(graph) - 1)
    typer.echo(
        f"{output}: {counted(len(graph), 'pose')}, {counted(len(graph.first), 'measurement')}; "
        f"expected error of the optimum {(residuals - free) / 2:g}"
    )
