"""`saga-fg bench`: benchmarks that print ratios to a baseline measured in the same run."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from pipelines.cli.bench_association import association
from pipelines.cli.bench_coasting import coasting
from pipelines.cli.bench_estimators import estimators
from pipelines.cli.bench_fusion import fusion
from pipelines.cli.bench_heterogeneous import heterogeneous
from pipelines.cli.bench_joint import joint
from pipelines.cli.bench_lidar import lidar
from pipelines.cli.bench_metrics import metrics
from pipelines.cli.bench_paper import paper
from pipelines.cli.bench_reading import reading
from pipelines.cli.bench_scaling import scaling
from pipelines.cli.bench_service import service
from pipelines.cli.bench_slam import slam
from pipelines.cli.bench_smoothing import smoothing
from pipelines.cli.bench_streaming import streaming
from pipelines.cli.bench_synthetic import synthetic
from pipelines.cli.bench_tracking import tracking
from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import ReportingGroup, progress_bar

bench_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file too.", metavar="FILE")]


bench_app.command()(association)
bench_app.command()(coasting)
bench_app.command()(estimators)
bench_app.command()(fusion)
bench_app.command()(scaling)
bench_app.command()(heterogeneous)
bench_app.command()(service)
bench_app.command()(metrics)
bench_app.command()(joint)
bench_app.command()(lidar)
bench_app.command()(slam)
bench_app.command()(smoothing)
bench_app.command()(streaming)
bench_app.command()(reading)
bench_app.command()(paper)
bench_app.command()(synthetic)
bench_app.command()(tracking)


@bench_app.callback()
def bench() -> None:
    """Measure: every figure is compared with a baseline in the same run."""


@bench_app.command()
def occlusion(
    scenes: Annotated[int, typer.Option("--scenes", min=2, help="Simulated scenes to compare on.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    fit_scenes: Annotated[int, typer.Option("--fit-scenes", min=1, help="Scenes the process noise is fitted on.")] = 6,
    fit_seed: Annotated[int, typer.Option("--fit-seed", min=0, help="Seed of the first of those.")] = 1000,
    json_file: Json = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """What the graph is worth where objects hide, on simulated traffic.

    Both methods have the process noise that is most likely on the fitting scenes, and differ in the edges alone. An
    object is hidden when no sensor sees it, and occluded if it is seen again.

    \b
    Examples:
      saga-fg bench occlusion
      saga-fg bench occlusion --scenes 20 --seed 100 --json figures.json
    """
    from data_tools.atomic_files import check_writable
    from pipelines.bench.occlusion import occlusion as run
    from pipelines.config import load_config
    from pipelines.figures import write_figures
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


@bench_app.command()
def bounded(
    nodes: Annotated[int, typer.Option("--nodes", min=10, help="Nodes of one connected graph.")] = 1000,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames that are counted.")] = 10,
    mixing: Annotated[float, typer.Option("--mixing", help="Share of velocity taken over in a frame.")] = 0.35,
    verbose: Verbose = False,
) -> None:
    """The bounded filter against the exact one: time, error and consistency for bounds of 1, 2 and 3 hops.

    \b
    Example:
      saga-fg bench bounded --nodes 300 --frames 5
    """
    from pipelines.bench.bounded import BoundedBenchSettings, bench_bounded

    table = Table(title=f"bounded filter, {nodes} connected nodes", title_justify="left")
    for column in ("hops", "ms", "time / exact", "mean error, sigma", "worst, sigma", "ANEES / exact"):
        table.add_column(column, justify="right")
    for row in bench_bounded(BoundedBenchSettings(nodes=nodes, frames=frames, mixing=mixing)):
        figures = (row.milliseconds, row.ratio, row.mean_error, row.worst_error, row.anees_ratio)
        table.add_row(str(row.hops), *(f"{x:.3g}" for x in figures))
    Console().print(table)
