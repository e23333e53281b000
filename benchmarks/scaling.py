"""`python -m benchmarks scaling`: node-only filtering against filters with node and edge states.

Cost and accuracy over the number of objects, on flocks of cars that share velocities (`benchmarks.flocks`,
`connected`), sampled from the model that all filters know; association is known. Besides the misses of single frames
every object is hidden for two seconds once, some at a time, so that interactions matter. Times are medians of CPU time
a frame on one thread, the contenders in turn; errors are root mean squares of positions, of objects while they are
hidden and of all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.contenders import Filter, Ours
from benchmarks.flocks import DT, Flock, FlockFrame, flock
from benchmarks.graph_tracking import JointGraphTracking, SeparateGraphTracking
from benchmarks.measuring import timed
from data_tools.figures import FigureTable, cell
from data_tools.files.atomic_files import check_writable, write_bytes
from data_tools.plots import png
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Verbose, counts
from pipelines.cli.tables import JsonFile, report
from pipelines.process import one_thread
from pipelines.tracking import Progress
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.scene_graph import SceneGraph
from saga_fg.numerics.arrays import BoolArray

NODES, JOINT, SEPARATE, APART = "nodes", "nodes and edges", "nodes and edges, each apart", "independent"
CONTENDERS: Mapping[str, Callable[[Flock], Filter]] = {
    NODES: lambda flock: Ours(JointKalmanFilter(), flock),
    SEPARATE: SeparateGraphTracking,
    JOINT: JointGraphTracking,
}
HIDDEN_FOR = 20  # frames
SHARES = 5  # of the objects, one after the other hidden
WARM_UP = 3  # frames that are not timed


@dataclass(frozen=True)
class ScalingRow:
    """One contender on a flock of so many nodes.

    states  numbers that are estimated; milliseconds of CPU time a frame, ratio to the node-only filter's;
    hidden_rmse and rmse of positions, m; largest_difference of a mean from that of the node-only filter, in its
    standard deviations
    """

    nodes: int
    contender: str
    states: int
    milliseconds: float
    ratio: float
    hidden_rmse: float
    rmse: float
    largest_difference: float


@dataclass(frozen=True)
class ScalingSettings:
    """sizes of the flocks; the filter over all nodes and edges together is run up to joint_limit of them."""

    sizes: Sequence[int] = (5, 10, 20, 50, 100, 200)
    joint_limit: int = 20
    frames: int = 140
    mixing: float = 0.35
    seed: int = 0


def bench_scaling(settings: ScalingSettings, progress: Progress | None = None) -> tuple[ScalingRow, ...]:
    """A row for every contender and size."""
    rows = []
    with one_thread():
        for done, n in enumerate(settings.sizes):
            rows += _of_size(n, settings)
            if progress is not None:
                progress(f"{n} objects", done + 1, len(settings.sizes))
    return tuple(rows)


def _of_size(n: int, settings: ScalingSettings) -> list[ScalingRow]:
    drawn = flock("connected", n, settings.frames, settings.seed, settings.mixing)
    hidden = _hidden(n, settings.frames)
    chosen = {name: make for name, make in CONTENDERS.items() if name != JOINT or n <= settings.joint_limit}
    filters = {name: make(drawn) for name, make in chosen.items()}
    filters[APART] = Ours(JointKalmanFilter(), drawn)
    times: dict[str, list[float]] = {name: [] for name in filters}
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in filters}
    furthest = dict.fromkeys(filters, 0.0)
    for number, (frame, away) in enumerate(zip(drawn.frames, hidden, strict=True)):
        told = replace(frame, measurements=_seen(frame.measurements, ~away))
        for name, each in filters.items():
            each.prepare(_without_edges(told) if name == APART else told)
            spent = timed(each.step)
            if number >= WARM_UP:
                times[name].append(spent)
            mean, P = each.read()
            error = ((mean - frame.truth)[:, :2] ** 2).mean(axis=1)
            squares[name].append((float(error[away].sum()), float(error.sum())))
            if name == NODES:
                reference, deviation = mean, np.sqrt(np.diagonal(P, axis1=1, axis2=2))
            furthest[name] = max(furthest[name], float((np.abs(mean - reference) / deviation).max()))
    counts = np.array([hidden.sum(), hidden.size])
    states = {NODES: 4 * n, APART: 4 * n, JOINT: 4 * n**2, SEPARATE: 4 * n**2}
    rows = []
    for name in filters:
        milliseconds, baseline = float(np.median(times[name])), float(np.median(times[NODES]))
        hidden_rmse, rmse = np.sqrt(np.sum(squares[name], axis=0) / counts).tolist()
        ratio, apart = milliseconds / baseline, furthest[name]
        rows.append(ScalingRow(n, name, states[name], milliseconds, ratio, hidden_rmse, rmse, apart))
    return rows


def _hidden(n: int, frames: int) -> BoolArray:
    """(frames, n) who is hidden: one share of the objects after the other."""
    turn = np.arange(frames)[:, None] // HIDDEN_FOR - 1
    return np.asarray((turn >= 0) & (np.arange(n) % SHARES == turn))


def _seen(measurements: Measurements, visible: BoolArray) -> Measurements:
    rows = visible[measurements.nodes]
    m = measurements
    return Measurements(m.nodes[rows], m.z[rows], m.H[rows], m.R[rows])


def _without_edges(frame: FlockFrame) -> FlockFrame:
    graph = frame.transition.graph
    return replace(frame, transition=discretise(SceneGraph.of(graph.nodes, graph.types[0]), DT))


def write_picture(path: Path, rows: Sequence[ScalingRow]) -> None:
    """Draw a PNG: times on logarithmic axes to the left, errors of hidden objects to the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    cost, accuracy = figure.subplots(1, 2)
    contenders = list(dict.fromkeys(row.contender for row in rows))
    for number, name in enumerate(contenders):
        mine = [row for row in rows if row.contender == name]
        for ax, values in ((cost, [r.milliseconds for r in mine]), (accuracy, [r.hidden_rmse for r in mine])):
            # the first on top, and finer, so that one that agrees with it stays in sight
            style = {"lw": 1.2 + number, "ms": 3 + 2 * number, "zorder": 9 - number}
            ax.plot([r.nodes for r in mine], values, "o-", label=name, **style)
    cost.set(xscale="log", yscale="log", xlabel="objects", ylabel="CPU time a frame, ms")
    accuracy.set(xscale="log", xlabel="objects", ylabel="position RMSE of hidden objects, m")
    accuracy.set_ylim(bottom=0.0)
    for ax in (cost, accuracy):
        ax.grid(alpha=0.3)
    figure.legend(*cost.get_legend_handles_labels(), loc="outside lower center", ncols=len(contenders), frameon=False)
    write_bytes(path, png(figure))


def scaling(
    objects: Annotated[
        str, typer.Option("--objects", help="Numbers of objects, with commas between.")
    ] = "5,10,20,50,100,200",
    joint_limit: Annotated[
        int, typer.Option("--joint-limit", min=2, help="Most objects for one filter over all nodes and edges.")
    ] = 20,
    frames: Annotated[int, typer.Option("--frames", min=30, help="Length of a recording.")] = 140,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the sampled recordings.")] = 0,
    json_file: JsonFile = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Draw the figures to this PNG.", metavar="PNG")
    ] = None,
    verbose: Verbose = False,
) -> None:
    """Cost and accuracy of filters that estimate nodes, and nodes and edges, over the number of objects.

    \b
    Examples:
      python -m benchmarks scaling
      python -m benchmarks scaling --objects 5,10,15 --frames 60 --json figures.json --output scaling.png
    """
    sizes = counts("--objects", objects, least=2)  # one has no neighbours
    if output is not None:
        check_writable(output)
    settings = ScalingSettings(sizes, joint_limit, frames, seed=seed)
    with progress_bar(unit="sizes") as progress:
        rows = bench_scaling(settings, progress)
    columns = ("objects", "filter", "numbers", "ms a frame", "/ nodes", "RMSE hidden, m", "RMSE, m", "off by, sigma")
    shown = []
    for row in rows:
        cells = (cell(row.milliseconds, 2), cell(row.ratio, 2), cell(row.hidden_rmse), cell(row.rmse))
        shown.append((str(row.nodes), row.contender, str(row.states), *cells, f"{row.largest_difference:.1e}"))
    table = FigureTable("nodes alone, and nodes and edges", columns, tuple(shown))
    report([table], {"settings": settings, "rows": rows}, json_file)
    if output is not None:
        write_picture(output, rows)
