"""Node-only filtering against filters with node and edge states: cost and accuracy over the number of objects.

Flocks of cars that share velocities (`benchmarks.flocks`, `connected`), sampled from the model that all filters know;
association is known. Besides the misses of single frames every object is hidden for two seconds once, some at a time,
so that interactions matter. Errors are root mean squares of positions, of objects while they are hidden and of all.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.filters import Filter, JointGraphTracking, Ours, SeparateGraphTracking
from benchmarks.flocks import DT, FlockFrame, flock
from benchmarks.runner import Rows, Seed, counts, each, in_turn
from saga_fg.estimators import JointKalmanFilter, Measurements
from saga_fg.model import SceneGraph, discretise

NODES, JOINT, SEPARATE, APART = "nodes", "nodes and edges", "nodes and edges, each apart", "independent"
HIDDEN_FOR, SHARES, MIXING = 20, 5, 0.35  # frames; parts of the objects, hidden one after the other; see `flock`
WARM_UP = 3  # frames that are not timed


def scaling(
    objects: Annotated[
        str, typer.Option("--objects", help="Numbers of objects, with commas between.")
    ] = "5,10,20,50,100,200",
    joint_limit: Annotated[
        int, typer.Option("--joint-limit", min=2, help="Most objects for one filter over all nodes and edges.")
    ] = 20,
    frames: Annotated[int, typer.Option("--frames", min=30, help="Length of a recording.")] = 140,
    seed: Seed = 0,
) -> Rows:
    """Cost and accuracy of filters that estimate nodes, and nodes and edges, over the number of objects.

    \b
    Examples:
      python -m benchmarks scaling
      python -m benchmarks scaling --objects 5,10,15 --frames 60 --json figures.json
    """
    for n in each(counts("--objects", objects, least=2), "objects"):  # one has no neighbours
        yield from (("nodes alone, and nodes and edges", row) for row in rows_of(n, n <= joint_limit, frames, seed))


def rows_of(n: int, joint: bool, frames: int, seed: int) -> list[dict[str, Any]]:
    """A row for every filter of a flock of n; differences are of a mean from the node-only filter's, in its sigmas."""
    drawn = flock("connected", n, frames, seed, MIXING)
    filters: dict[str, Filter] = {NODES: Ours(JointKalmanFilter(), drawn), SEPARATE: SeparateGraphTracking(drawn)}
    filters |= {JOINT: JointGraphTracking(drawn)} if joint else {}
    filters[APART] = Ours(JointKalmanFilter(), drawn)
    turn = np.arange(frames)[:, None] // HIDDEN_FOR - 1
    hidden = (turn >= 0) & (np.arange(n) % SHARES == turn)
    squares = {name: np.zeros(2) for name in filters}
    furthest = dict.fromkeys(filters, 0.0)

    def judged() -> Iterator[FlockFrame]:
        """The frames; once all filters have taken one in, their errors."""
        for frame, away in zip(drawn.frames, hidden, strict=True):
            m, seen = frame.measurements, ~away[frame.measurements.nodes]
            yield replace(frame, measurements=Measurements(m.nodes[seen], m.z[seen], m.H[seen], m.R[seen]))
            reference, P = filters[NODES].read()
            deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
            for name, one in filters.items():
                mean, _ = one.read()
                error = ((mean - frame.truth)[:, :2] ** 2).mean(axis=1)
                squares[name] += error[away].sum(), error.sum()
                furthest[name] = max(furthest[name], float((np.abs(mean - reference) / deviation).max()))

    contenders = {name: one.prepare for name, one in filters.items()}
    contenders[APART] = lambda frame: filters[APART].prepare(_without_edges(frame))
    times = {name: float(np.median(spent)) for name, spent in in_turn(contenders, judged(), WARM_UP).items()}
    rows = []
    for name, ms in times.items():
        numbers = 4 * n if name in (NODES, APART) else 4 * n**2
        away_rmse, rmse = np.sqrt(squares[name] / [hidden.sum(), hidden.size]).tolist()
        row = {"objects": n, "filter": name, "numbers": numbers, "ms a frame": ms, "/ nodes": ms / times[NODES]}
        rows.append({**row, "RMSE hidden, m": away_rmse, "RMSE, m": rmse, "off by, sigma": furthest[name]})
    return rows


def _without_edges(frame: FlockFrame) -> FlockFrame:
    graph = frame.transition.graph
    return replace(frame, transition=discretise(SceneGraph.of(graph.nodes, graph.types[0]), DT))
