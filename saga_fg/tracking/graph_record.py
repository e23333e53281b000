"""The running graph as a value that JSON can hold, to be drawn: variables where they are, factors by kind.

nodes    name ("car 12 at 3.40 s"), kind, time (s; null: for all time), position [x, y], m, in the world; where known
         covariance (2, 2), m^2, and outline [[x, y], ...] of a box or of a line of the map
factors  kind; nodes: their numbers in the list above; at: the place [x, y] that was detected; edges: the interaction
         function and the rate, 1/s, by which each node from the third on acts on the first

Variables without a place, such as biases, are left out, and so are factors on these alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from saga_fg.arrays import FloatArray
from saga_fg.graph import EGO_ERROR, MAP_NODE, OBJECT, GraphVariable, SceneFactorGraph
from saga_fg.tracking.observer import TrackerView

OWN = {"interactions": "interaction", "detections": "detection", "births": "birth", "marginals": "marginal prior"}
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

        known: numbers of nodes that are here already, by key, with the toolkit's own factors on them; covariance: of a
        variable by key, as the estimator's method
        """
        number = dict(known or {})
        for key, variable in graph.variables.items():
            place = None if key in number else _place(variable, graph.state(key))
            if place is not None:
                more: dict[str, FloatArray] = {}
                if covariance is not None and isinstance(graph.state(key), np.ndarray):
                    more["covariance"] = covariance(key)[:2, :2]
                name = f"{variable.label} {variable.id}"
                number[key] = self.node(variable.kind.name, name, variable.time, place + np.asarray(origin), **more)
        for factor in graph.factors():
            keys = [variable.key for variable in factor.variables if variable.key in number]
            if keys and not (known and factor.provider in OWN and known.keys() >= set(keys)):
                kind = OWN.get(factor.provider, f"{factor.provider}: {factor.kind}")
                self.factor(kind, [number[key] for key in keys])


def graph_of_frame(before: TrackerView | None, now: TrackerView, start: float) -> dict[str, Any]:
    """The graph of the interval that a frame ended, as the stage `births` leaves it; `before`: the frame before.

    Times are counted from `start`. The states at the beginning of the interval have a joint prior, which is not listed.
    """
    record, time = GraphRecord(), now.timestamp - start
    names = [f"{label} {id_}" for id_, label in zip(now.columns.id.tolist(), now.columns.label.tolist(), strict=True)]
    boxes, corners = now.boxes, now.boxes.corners()
    numbers = {
        id_: record.node(
            OBJECT.name, names[row], time, boxes.position[row, :2], covariance=now.P[row], outline=corners[row]
        )
        for row, id_ in enumerate(now.columns.id.tolist())
    }
    if before is not None and now.graph is not None and now.timestamp > before.timestamp:
        _interactions(record, before, now, numbers, start)
    if now.matching is not None and now.observed is not None:
        places = now.observed.boxes.position[:, :2]
        for row, detection in zip(now.matching.track.tolist(), now.matching.detection.tolist(), strict=True):
            record.factor("detection", [row], at=_rounded(places[detection]))
        for row, detection in enumerate(now.born.tolist(), start=len(names) - len(now.born)):
            record.factor("birth", [row], at=_rounded(places[detection]))
        viewpoint = now.observed.viewpoint
        if now.running is not None:
            ours = {one.key: numbers[id_] for id_, one in now.running.of(OBJECT, now.running.epoch).items()}
            record.add(now.running, now.origin, ours)
        elif viewpoint is not None:
            record.node(KNOWN_POSE, "vehicle", time, viewpoint[:2])
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


def _place(variable: GraphVariable, state: Any) -> FloatArray | None:
    if isinstance(state, gtsam.Pose2 | gtsam.Pose3):
        return np.asarray(state.translation())[:2]
    vector = isinstance(state, np.ndarray) and len(state) >= 2 and variable.kind != EGO_ERROR
    return state[:2] if vector else None


def _rounded(values: ArrayLike) -> Any:
    return np.round(np.asarray(values, dtype=float), 3).tolist()
