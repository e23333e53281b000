"""`python -m benchmarks smoothing`: are the covariances right, and what are the edges worth?"""

from __future__ import annotations

from typing import Annotated

import typer

from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile


def smoothing(
    samples: Annotated[int, typer.Option("--samples", min=10, help="Independent samples drawn from the model.")] = 2000,
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them, and of what is drawn.")] = 0,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """The smoother against its own covariances, and with against without edges where objects hide.

    Association is known in both, so that nothing but the smoother is measured.

    \b
    Examples:
      python -m benchmarks smoothing
      python -m benchmarks smoothing --samples 1000 --scenes 4 --seed 100 --json figures.json
    """
    from benchmarks.drawn_recordings import drawn_fit
    from benchmarks.hidden_objects import hidden_objects
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from pipelines.smoothing import load_smooth_config

    settings = load_smooth_config("simulated", config)
    if json_file is not None:
        check_writable(json_file)
    drawn = drawn_fit(samples, seed)
    typer.echo(
        f"drawn from the model, {drawn.samples} independent samples: RMSE {drawn.measured:.4f} m, predicted by the "
        f"covariances {drawn.predicted:.4f} m, ratio {drawn.ratio:.3f}"
    )
    with progress_bar(unit="scenes") as progress:
        hidden = hidden_objects(settings, range(seed, seed + scenes), progress)
    change = hidden.change
    typer.echo(
        f"hidden objects in {scenes} simulated scenes, {hidden.boxes} boxes: RMSE {hidden.with_edges:.3f} m with "
        f"edges, {hidden.without_edges:.3f} m without: {100 * change.estimate:+.1f} % "
        f"({100 * change.confidence:.0f} % interval {100 * change.low:+.1f} to {100 * change.high:+.1f} %)"
    )
    if json_file is not None:
        write_figures(json_file, {"drawn": drawn, "ratio": drawn.ratio, "hidden": hidden})
