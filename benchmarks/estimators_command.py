"""`python -m benchmarks estimators`: cost and exactness of every estimator, beside its baseline."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose, counts
from pipelines.cli.tables import JsonFile, report, show_tables

if TYPE_CHECKING:
    from benchmarks.estimator_figures import Row
    from benchmarks.estimators import EstimatorBench
    from data_tools.figures import FigureTable


def estimators(
    sizes: Annotated[
        str, typer.Option("--sizes", help="Numbers of nodes, with commas between.")
    ] = "10,50,100,300,1000",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of each case that are counted.")] = 20,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, help="No more frames of a case after that.")] = 30.0,
    batch_frames: Annotated[
        int, typer.Option("--batch-frames", min=0, help="Length of the batch smoothers' recording; 0: none.")
    ] = 200,
    batch_nodes: Annotated[int, typer.Option("--batch-nodes", min=2, help="Nodes of that recording.")] = 100,
    soak_frames: Annotated[
        int, typer.Option("--soak-frames", min=0, help="Frames of the endurance run; 0: none.")
    ] = 10_000,
    soak_nodes: Annotated[int, typer.Option("--soak-nodes", min=2, help="Nodes of the endurance run.")] = 100,
    scenes: Annotated[
        int, typer.Option("--scenes", min=0, help="Nonlinear scenes drawn from the model; 0: none.")
    ] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of what is simulated.")] = 0,
    everything: Annotated[bool, typer.Option("--all", help="Measure the hopeless cases too: hours.")] = False,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Measure time, memory and exactness of the estimators.

    Filters are compared with the textbook's on dense matrices, fixed-lag smoothers with GTSAM's, batch smoothers with
    Rauch, Tung and Striebel's, a running graph of intelligent drivers with a linear one, and one with a lag with the
    whole graph. All run in turn on one thread; times are medians of CPU time.

    \b
    Examples:
      python -m benchmarks estimators
      python -m benchmarks estimators --sizes 10,100 --frames 5 --soak-frames 0 --json figures.json
    """
    from benchmarks.estimators import EstimatorBenchSettings, bench_estimators

    settings = EstimatorBenchSettings(
        counts("--sizes", sizes),
        frames,
        seconds,
        batch_frames,
        batch_nodes,
        soak_frames,
        soak_nodes,
        scenes,
        seed,
        everything=everything,
    )
    with progress_bar(unit="cases") as progress:
        result = bench_estimators(settings, progress)
    tables = _tables(result)
    report(tables[:1], _figures(result), json_file)
    for name, exponent in result.exponents.items():
        typer.echo(f"cost of {name}: grows as nodes^{exponent:.2f}")
    for soak in result.soaks:
        ms, memory = soak.milliseconds, soak.memory
        typer.echo(
            f"{soak.contender}, {soak.graph}, {soak.nodes} nodes, {soak.frames} frames: {ms[1]:.3g} ms a frame at the "
            f"end, {ms[0]:.3g} ms of a young filter in turn with it; {memory[0]:.0f} MB at the start, "
            f"{memory[1]:.0f} MB at the end"
        )
    show_tables(tables[1:])
    typer.echo(", ".join(f"{name} {value}" for name, value in result.environment.items()))


def _tables(result: EstimatorBench) -> list[FigureTable]:
    """The rows, and the figures to reach."""
    from data_tools.figures import FigureTable

    rows = []
    for row in result.rows:
        cells = [f"{row.milliseconds:.3g}", _number(row.ratio), _number(row.largest_error, ".1e")]
        cells += [_number(row.covariance_error, ".1e"), _number(row.anees, ".3f") + _band(row), _number(row.memory)]
        rows.append((row.case, row.graph, str(row.nodes), row.contender, *cells))
    columns = ("case", "graph", "nodes", "estimator", "ms", "ratio", "largest error", "covariance", "ANEES", "MB")
    words = {True: "reached", False: "missed", None: "not measured"}
    criteria = tuple((c.name, _number(c.value), f"<= {c.limit}", words[c.reached]) for c in result.criteria)
    return [
        FigureTable("cost, and error in standard deviations", columns, tuple(rows)),
        FigureTable("figures to reach", ("figure", "measured", "to reach", ""), criteria),
    ]


def _band(row: Row) -> str:
    return "" if math.isnan(row.band[0]) else f" ({row.band[0]:.2f} to {row.band[1]:.2f})"


def _number(value: float, form: str = ".3g") -> str:
    return "" if math.isnan(value) else format(value, form)


def _figures(result: EstimatorBench) -> dict[str, Any]:
    """The figures for programs, with the result of each criterion."""
    criteria = [asdict(criterion) | {"reached": criterion.reached} for criterion in result.criteria]
    return asdict(result) | {"criteria": criteria}
