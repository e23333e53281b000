"""The running graph as a value that JSON can hold, to be drawn: variables at their positions, factors by kind.

nodes    name ("car 12 at 3.40 s"), kind, time (s; null: for all time), position [x, y], m, in the world; where known
         covariance (2, 2), m^2, and outline [[x, y], ...] of a box or of a line of the map
factors  kind; nodes: their numbers in the list above; edges: the interaction function and the rate, 1/s, by which each
         node from the third on acts on the first

Variables without a position, such as biases, are left out, and so are factors on these alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from saga_fg.graph import EGO_ERROR, MAP_NODE, OBJECT, GraphVariable, SceneFactorGraph
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking.observer import TrackerView

OWN = {
    "interactions": "interaction",
    "detections": "detection",
    "new objects": "initiation",
    "marginals": "marginal prior",
}
"""Kinds of the factors that the toolkit's own providers add, by provider."""
KNOWN_POSE = "known ego pose"  # no variable


class GraphRecord:
    """Nodes and factors, collected."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.factors: list[dict[str, Any]] = []

    def node(self, kind: str, name: str, time: float | None, position: ArrayLike, **more: ArrayLike) -> int:
        """Add a node; returns its number. `more`: covariance and outline, left out where they are not finite."""
        known = {key: _rounded(value) for key, value in more.items() if np.isfinite(value).all() and np.size(value)}
        where = name if time is None else f"{name} at {time:.2f} s"
        self.nodes.append({"name": where, "kind": kind, "time": time, "position": _rounded(position), **known})
        return len(self.nodes) - 1

    def factor(self, kind: str, nodes: list[int], **more: Any) -> None:
        """Add a factor on nodes."""
        self.factors.append({"kind": kind, "nodes": nodes, **more})

    def add(
        self,
        graph: SceneFactorGraph,
        origin: ArrayLike = (0.0, 0.0),
        known: Mapping[int, int] | None = None,
        covariance: Callable[[int], FloatArray] | None = None,
    ) -> None:
        """Add a running graph, whose positions are from `origin`.

        known: numbers of nodes that are here already, by key; then only factors on the present are added, without
        interactions; covariance: of a variable by key, as the estimator's method
        """
        numbers, origin = dict(known or {}), np.asarray(origin, dtype=float)

        def number(variable: GraphVariable) -> int:
            key = variable.key
            if key not in numbers:
                vector = covariance is not None and isinstance(graph.state(key), np.ndarray)
                more = {"covariance": covariance(key)[:2, :2]} if covariance is not None and vector else {}
                name, place = f"{variable.label} {variable.id}", _position(variable, graph) + origin
                numbers[key] = self.node(variable.kind.name, name, variable.time, place, **more)
            return numbers[key]

        for factor in graph.factors():
            on = [variable for variable in factor.variables if len(_position(variable, graph))]
            present = any(variable.epoch in (graph.epoch, None) for variable in on)
            if on and (known is None or (present and factor.provider not in ("interactions", "marginals"))):
                self.factor(OWN.get(factor.provider, f"{factor.provider}: {factor.kind}"), [number(one) for one in on])


def graph_of_frame(before: TrackerView | None, now: TrackerView, start: float) -> dict[str, Any]:
    """The graph of the interval that a frame ended, at the stage `initiate`; `before`: the frame before.

    Times are counted from `start`. The states at the beginning of the interval have a joint prior, which is not listed.
    """
    record, time, n = GraphRecord(), now.timestamp - start, len(now.table.id)
    table, corners, numbers = now.nodes, now.boxes.corners(), dict[int, int]()
    for row, id_ in enumerate(table.id.tolist()):
        if id_ >= 0:
            more = {"covariance": now.P[row], "outline": corners[row]} if row < n else {}
            place = table.position[row] + now.origin
            numbers[id_] = record.node(OBJECT.name, f"{table.label[row]} {id_}", time, place, **more)
    if before is not None and now.graph is not None and now.timestamp > before.timestamp:
        _interactions(record, before, now, numbers, start)
    if now.running is not None:
        present = now.running.of(OBJECT, now.running.epoch)
        ours = {one.key: numbers[id_] for id_, one in present.items() if id_ in numbers}  # others were handed over
        record.add(now.running, now.origin, ours)
    elif now.matching is not None and now.measurements is not None:
        for row in now.matching.track.tolist():
            record.factor("detection", [row])
        for row in range(n - len(now.initiated), n):
            record.factor("initiation", [row])
        if now.measurements.viewpoint is not None:
            record.node(KNOWN_POSE, "vehicle", time, now.measurements.viewpoint[:2])
    return {"nodes": record.nodes, "factors": record.factors}


def _interactions(
    record: GraphRecord, before: TrackerView, now: TrackerView, numbers: Mapping[int, int], start: float
) -> None:
    """States at the beginning of the interval, the nodes of the map that act, and one interaction factor a track."""
    assert now.graph is not None
    table, time, graph = before.nodes, before.timestamp - start, now.graph
    rows = {id_: row for row, id_ in enumerate(table.id.tolist())}
    earlier: dict[int, int] = {}

    def node(id_: int) -> int:
        if id_ not in earlier:
            row, name = rows[id_], f"{table.label[rows[id_]]} {abs(id_)}"
            place, line = table.position[row] + before.origin, table.outline.get(row, np.empty(0))
            if id_ < 0:
                outline = line + before.origin if len(line) else line
                earlier[id_] = record.node(MAP_NODE.name, name, None, place, outline=outline)
            else:
                earlier[id_] = record.node(OBJECT.name, name, time, place)
        return earlier[id_]

    acting: dict[int, list[tuple[int, str, float]]] = {}
    ids = graph.nodes.tolist()
    for group in graph.edges:
        for target, source, rate in zip(group.target.tolist(), group.source.tolist(), group.rate.tolist(), strict=True):
            acting.setdefault(ids[target], []).append((ids[source], group.interaction, rate))
    for id_ in ids:
        if id_ in numbers and id_ in rows:
            on = [one for one in acting.get(id_, ()) if one[0] in rows]
            nodes = [numbers[id_], node(id_), *(node(source) for source, _, _ in on)]
            record.factor("interaction", nodes, edges=[[name, round(rate, 3)] for _, name, rate in on])


def _position(variable: GraphVariable, graph: SceneFactorGraph) -> FloatArray:
    """Position (2,) of a variable, m; (0,) for one without a position."""
    state = graph.state(variable.key)
    if isinstance(state, gtsam.Pose2 | gtsam.Pose3):
        return np.asarray(state.translation())[:2]
    vector = isinstance(state, np.ndarray) and len(state) >= 2 and variable.kind != EGO_ERROR
    return np.asarray(state[:2] if vector else np.empty(0))


def _rounded(values: ArrayLike) -> Any:
    return np.round(np.asarray(values, dtype=float), 3).tolist()
