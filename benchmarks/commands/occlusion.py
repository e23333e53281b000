"""What the graph is worth where objects hide."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile


def occlusion(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes to compare on.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    fit_scenes: Annotated[int, typer.Option("--fit-scenes", min=1, help="Scenes the process noise is fitted on.")] = 6,
    fit_seed: Annotated[int, typer.Option("--fit-seed", min=0, help="Seed of the first of those.")] = 1000,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """What the graph is worth where objects hide, on simulated traffic.

    Both methods have the process noise that is most likely on the fitting scenes, and differ in the edges alone. An
    object is hidden when no sensor sees it, and occluded if it is seen again.

    \b
    Examples:
      python -m benchmarks occlusion
      python -m benchmarks occlusion --scenes 20 --seed 100 --json figures.json
    """
    from benchmarks.occlusion import occlusion as run
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from pipelines.config import load_config
    from saga_fg.errors import InputError

    fit_seeds, seeds = range(fit_seed, fit_seed + fit_scenes), range(seed, seed + scenes)
    if set(fit_seeds) & set(seeds):
        raise InputError(f"--fit-seed {fit_seed}: expected other scenes to fit on than to compare on")
    if json_file is not None:
        check_writable(json_file)
    with progress_bar() as progress:
        result = run(load_config("simulated", config), seeds, fit_seeds, progress=progress)
    table = Table(title=f"{scenes} simulated scenes; RMSE in m, lost objects count with 5 m", title_justify="left")
    for column in ("method", "hidden", "occluded", "in view", "hidden: median", "MOTA", "ID switches"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for method, m in result.hidden.items():
        carried = m.carried
        errors = (carried.rmse, result.occluded[method].carried.rmse, m.position.rmse, carried.median, m.mota)
        table.add_row(method, *(f"{x:.3f}" for x in errors), str(m.switches))
    Console().print(table)
    noise = ", ".join(f"{label} {q:.3g}" for label, q in result.acceleration_noise.items())
    typer.echo(f"acceleration noise fitted on {fit_scenes} other scenes, m^2/s^3: {noise}")
    for name, change in (("hidden", result.hidden_change), ("occluded", result.occluded_change)):
        typer.echo(
            f"RMSE of {name} objects, saga against kf: {100 * change.estimate:+.1f} % "
            f"({100 * change.confidence:.0f} % interval {100 * change.low:+.1f} to {100 * change.high:+.1f} %)"
        )
    if json_file is not None:
        figures = {
            "seeds": result.seeds,
            "fit_seeds": result.fit_seeds,
            "acceleration_noise": result.acceleration_noise,
            "occluded_rmse": {method: m.carried.rmse for method, m in result.occluded.items()},
            "occluded_change": asdict(result.occluded_change),
            "hidden_rmse": {method: m.carried.rmse for method, m in result.hidden.items()},
            "hidden_change": asdict(result.hidden_change),
        }
        write_figures(json_file, figures)
