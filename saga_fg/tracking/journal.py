"""Observing a tracker at work: stages of a frame, a journal of every track, its running graph.

An observer is told of the end of each step of a frame, and may ask for the state and the results. A tracker without an
observer pays nothing for the possibility; a view is made only for an observer that asks for it.

A journal of a tracker: an event for every track and frame with the reasons, as values that JSON can hold.

    initiated  detection and its probability, and the nearest tracks that did not take it
    matched    candidates with their squared distances in sigmas, the chosen one, and why the others were not chosen
    missed     candidates, none of which was chosen
    unsettled  in frames for which the solver found no minimum of the graph, as far as the track is concerned
    deleted    time without a detection, existence, and the limit that was passed
    clocks     offsets of the sensors' clocks, whenever one is corrected anew, or its frames are left out or used again
    graph      running graph of the interval that the frame ended, once a frame
    relations  right of way: rows of `saga_fg.types.track.Relations`, where there are any

`matched` and `missed` also list the edges that acted on the prediction, and the effect of each. Positions are in world
coordinates.

The running graph as a value that JSON can hold, to be drawn: variables at their positions, factors by kind.

nodes    name ("car 12 at 3.40 s"), kind, time (s; null: for all time), position [x, y], m, in the world; where known
         covariance (2, 2), m^2, and outline [[x, y], ...] of a box or of a line of the map
factors  kind; nodes: their numbers in the list above; edges: the interaction function and the rate, 1/s, by which each
         node from the third on acts on the first

Variables without a position, such as biases, are left out, and so are factors on these alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal, Protocol

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from saga_fg.graph import EGO_ERROR, EGO_VELOCITY, MAP_NODE, OBJECT, GraphVariable, SceneFactorGraph
from saga_fg.model import EdgeEffect, NodeTable, SceneGraph, edge_effects
from saga_fg.numerics import BoolArray, FloatArray, IntArray, Matching, gate, mahalanobis
from saga_fg.tracking.clock import Clock
from saga_fg.tracking.clock_offsets import SensorTime, SharedObservations, sensor_times
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.prediction import node_table
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.tracking.track_table import TrackTable
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import Boxes, class_settings

Stage = Literal["predict", "measure", "associate", "update", "existence", "initiate", "delete", "report"]


@dataclass(frozen=True, eq=False)
class TrackerView:
    """A tracker with n tracks at the end of a stage.

    timestamp     s, of the state
    sensor        of the frame
    table         the tracks, with times in s as timestamps are
    nodes         as edge rules see them: the tracks, the vehicle, the map; positions are local, see `origin`
    P             (n, 2, 2) covariance of the positions, m^2
    origin        (2,) of the local positions in the world, m
    graph         scene graph of the latest interval, None before the first
    measurements  of the frame, from the stage `measure` on
    matching      rows of tracks and of measurements, from the stage `associate` on
    initiated     (b,) rows of the measurements that initiated the last b tracks, at the stage `initiate`
    boxes         of the tracks, in the world
    clock, shared of the sensors, and what their frames have in common, see `clocks`
    settled       (n,) tracks for which the solver has found the minimum of the graph
    running       the running graph, where factor providers take part; its positions are local
    relations     rows of `saga_fg.types.track.Relations`
    """

    timestamp: float
    sensor: str
    table: TrackTable
    nodes: NodeTable
    P: FloatArray
    origin: FloatArray
    graph: SceneGraph | None
    measurements: FrameMeasurements | None
    matching: Matching | None
    initiated: IntArray
    boxes: Boxes
    clock: Clock
    shared: SharedObservations
    settled: BoolArray
    running: SceneFactorGraph | None
    relations: list[tuple[int, int, str, float]]

    @classmethod
    def from_state(
        cls,
        state: TrackerState,
        sensor: str,
        measurements: FrameMeasurements | None = None,
        matching: Matching | None = None,
        initiated: IntArray | None = None,
    ) -> TrackerView:
        """View a state and the results of a frame so far."""
        table, now = state.table.copied(), state.kinematics()
        table.last_detected += state.start
        return cls(
            timestamp=state.start + state.time,
            sensor=sensor,
            table=table,
            nodes=node_table(state),
            P=now.P,
            origin=state.origin,
            graph=state.graph,
            measurements=measurements,
            matching=matching,
            initiated=np.empty(0, dtype=np.int64) if initiated is None else initiated,
            boxes=replace(state.boxes(now.position, now.velocity)),
            clock=state.clock,
            shared=state.shared,
            settled=state.joint.settled(table.id),
            running=state.joint.estimator.graph() if state.providers else None,
            relations=state.right_of_way.relations(table.id).rows(),
        )

    @property
    def clocks(self) -> dict[str, SensorTime]:
        """The clocks of the sensors, where there are several."""
        return sensor_times(self.clock, self.shared) if len(self.clock.sensors) > 1 else {}

    def positions(self) -> FloatArray:
        """(n, 2) positions of the tracks in the world, m."""
        return np.asarray(self.nodes.position[: len(self.table)] + self.origin)


class Observer(Protocol):
    """Anything that observes how a tracker comes to its tracks."""

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Take note of a stage; `view()` returns the tracker's view and is valid during this call only."""
        ...


OWN = {
    "interactions": "interaction",
    "detections": "detection",
    "new objects": "initiation",
    "marginals": "marginal prior",
}
"""Kinds of the factors that the toolkit's own providers add, by provider."""
KNOWN_POSE = "known ego pose"  # no variable


class EventGraph:
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
    record, time, n = EventGraph(), now.timestamp - start, len(now.table.id)
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
    record: EventGraph, before: TrackerView, now: TrackerView, numbers: Mapping[int, int], start: float
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
    placed = isinstance(state, np.ndarray) and len(state) >= 2 and variable.kind not in (EGO_VELOCITY, EGO_ERROR)
    return np.asarray(state[:2] if placed else np.empty(0))


def _rounded(values: ArrayLike) -> Any:
    return np.round(np.asarray(values, dtype=float), 3).tolist()


Event = dict[str, Any]
LISTED = 5  # candidates of an event
RETURNED = "it is the return of an earlier track"
NEAR = 4.0  # candidates up to this multiple of the gate, as a squared distance, are listed


class Journal:
    """An observer that hands one event for each track and frame to `write`. `settings` are the tracker's."""

    def __init__(self, settings: TrackerSettings, write: Callable[[Event], None]) -> None:
        self._settings, self._write = settings, write
        self._before: TrackerView | None = None  # at the end of the frame before
        self._predicted: TrackerView | None = None
        self._matched: TrackerView | None = None
        self._effects: list[EdgeEffect] = []
        self._start: float | None = None
        self._clocks: dict[str, tuple[float, str]] = {}
        self._related = False

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Take note of a stage."""
        if stage == "predict":
            self._predicted = view()
            self._effects = self._edge_effects(self._predicted)
        elif stage == "existence":
            self._matched = view()
            self._write_matches(self._matched)
        elif stage == "initiate":
            now = view()
            self._start = now.timestamp if self._start is None else self._start
            graph = graph_of_frame(self._before, now, self._start)
            self._write({"event": "graph", "time": now.timestamp, "sensor": now.sensor, **graph})
            self._before = now
            assert self._matched is not None
            self._write_ends(self._matched, now, lambda row: RETURNED)
            self._write_initiations(now)
        elif stage == "delete":
            now = view()
            self._write_unsettled(now)
            assert self._before is not None
            self._write_ends(self._before, now, partial(self._reason, self._before))
            self._write_clocks(now)
            if now.relations or self._related:
                self._related = bool(now.relations)
                event = {"event": "relations", "time": now.timestamp, "sensor": now.sensor}
                self._write(event | {"relations": now.relations})
            self._before = now

    def _write_clocks(self, now: TrackerView) -> None:
        known = now.clocks
        state: dict[str, tuple[float, str]] = {n: (round(each.corrected, 2), each.verdict) for n, each in known.items()}
        if state != self._clocks:
            clocks = {name: asdict(each) for name, each in known.items()}
            self._write({"event": "clocks", "time": now.timestamp, "sensor": now.sensor, "clocks": clocks})
            self._clocks = state

    def _edge_effects(self, now: TrackerView) -> list[EdgeEffect]:
        before = self._before
        if before is None or now.graph is None or now.timestamp <= before.timestamp:
            return []
        return edge_effects(now.graph, now.timestamp - before.timestamp, before.nodes)

    def _write_matches(self, now: TrackerView) -> None:
        assert self._predicted is not None
        assert now.measurements is not None
        assert now.matching is not None
        taken = dict(zip(now.matching.detection.tolist(), now.table.id[now.matching.track].tolist(), strict=True))
        chosen = dict(zip(now.matching.track.tolist(), now.matching.detection.tolist(), strict=True))
        positions = self._predicted.positions()
        for row, id_ in enumerate(now.table.id.tolist()):
            detection = chosen.get(row)
            event = self._event("missed" if detection is None else "matched", now, id_, row)
            event["predicted"] = _numbers(positions[row])
            event["deviation"] = _numbers(np.sqrt(np.diagonal(self._predicted.P[row])))
            event["candidates"] = self._candidates(row, positions[row], now.measurements, taken, detection)
            if detection is not None:
                event["position"] = _numbers(now.positions()[row])
            event["existence"] = [float(view.table.existence[row]) for view in (self._predicted, now)]
            event["coasting"] = float(now.timestamp - now.table.last_detected[row])
            event["edges"] = [_edge(effect) for effect in self._effects if effect.target == id_]
            self._write(event)

    def _candidates(
        self, row: int, position: FloatArray, measurements: FrameMeasurements, taken: dict[int, int], chosen: int | None
    ) -> list[Event]:
        """Detections near a track, of its class or one confused with it, nearest first; the chosen one among them."""
        assert self._predicted is not None
        label = str(self._predicted.table.label[row])
        settings = class_settings(self._settings.classes, ClassSettings, label)
        confused = (measurements.class_likelihood > 0) & np.isfinite(self._predicted.table.class_belief[row])
        rows = np.flatnonzero((measurements.boxes.label == label) | confused.any(axis=1))
        measured = measurements.boxes.position[rows, :2]
        d2, _ = mahalanobis(position[None], self._predicted.P[row][None], measured, measurements.R[rows, :2, :2])
        apart, limit = np.hypot(*(measured - position).T), gate(settings.gate)
        near = [k for k in np.argsort(d2[0]).tolist() if d2[0, k] < NEAR * limit or rows[k] == chosen]
        result = []
        for k in near[:LISTED] + [k for k in near[LISTED:] if rows[k] == chosen]:
            detection = int(rows[k])
            if detection == chosen:
                outcome = "chosen"
            elif d2[0, k] >= limit:
                outcome = "outside the gate"
            elif apart[k] >= settings.max_distance:
                outcome = "too far"
            elif detection in taken:
                outcome = f"taken by track {taken[detection]}"
            else:
                outcome = "less likely than a miss and a false detection"
            result.append(
                {
                    "detection": int(measurements.row[detection]),
                    "position": _numbers(measured[k]),
                    "probability": float(measurements.probability[detection]),
                    "distance2": float(d2[0, k]),
                    "gate": limit,
                    "metres": float(apart[k]),
                    "outcome": outcome,
                }
            )
        return result

    def _write_unsettled(self, now: TrackerView) -> None:
        for row in np.flatnonzero(~now.settled).tolist():
            event = self._event("unsettled", now, int(now.table.id[row]), row)
            self._write(event | {"deviation": _numbers(np.sqrt(np.diagonal(now.P[row])))})

    def _write_initiations(self, now: TrackerView) -> None:
        assert self._predicted is not None
        assert now.measurements is not None
        old = self._predicted
        for n, detection in enumerate(now.initiated.tolist()):
            row = len(now.table.id) - len(now.initiated) + n
            event = self._event("initiated", now, int(now.table.id[row]), row)
            measured = now.measurements.boxes.position[detection, :2]
            same = np.flatnonzero(old.table.label == now.table.label[row])
            noise = now.measurements.R[detection, :2, :2][None]
            d2, _ = mahalanobis(old.positions()[same], old.P[same], measured[None], noise)
            nearest = same[np.argsort(d2[:, 0])[:3]]
            of_class = class_settings(self._settings.classes, ClassSettings, event["label"])
            event |= {
                "detection": int(now.measurements.row[detection]),
                "position": _numbers(measured),
                "probability": float(now.measurements.probability[detection]),
                "least_probability": of_class.initiation_score,
                "gate": gate(of_class.gate),
                "nearest_tracks": [
                    {"track": int(old.table.id[k]), "distance2": float(d2[same == k, 0][0])} for k in nearest.tolist()
                ],
            }
            self._write(event)

    def _write_ends(self, last: TrackerView, now: TrackerView, reason: Callable[[int], str]) -> None:
        """Write why the tracks of the view before, `last`, are not in this one; reason: by rows of `last`."""
        for row in np.flatnonzero(~np.isin(last.table.id, now.table.id)).tolist():
            event, why = self._event("deleted", last, int(last.table.id[row]), row), reason(row)
            coasting = 0.0 if why == RETURNED else float(last.timestamp - last.table.last_detected[row])
            existence = float(last.table.existence[row])
            self._write(event | {"coasting": coasting, "existence": existence, "reason": why})

    def _reason(self, last: TrackerView, row: int) -> str:
        """Why a track was deleted."""
        settings, coasting = self._settings, float(last.timestamp - last.table.last_detected[row])
        if coasting > settings.max_coasting:
            return f"not detected for longer than {settings.max_coasting:g} s"
        if not last.table.confirmed[row] and last.table.seen_existence[row] < settings.existence.delete_below:
            return f"existence below {settings.existence.delete_below:g} before it was confirmed"
        if coasting > 0:
            return "its place is no longer known well enough to report it or to find it again"
        return "another track took its place"

    def _event(self, kind: str, view: TrackerView, id_: int, row: int) -> Event:
        return {
            "event": kind,
            "time": view.timestamp,
            "sensor": view.sensor,
            "track": id_,
            "label": str(view.table.label[row]),
            "confirmed": bool(view.table.confirmed[row]),
        }


def of_scene(write: Callable[[Event], None], scene: str) -> Callable[[Event], None]:
    """Return a `write` that adds the scene's name to every event."""
    return lambda event: write({"scene": scene, **event})


def _edge(effect: EdgeEffect) -> Event:
    return {
        "from": effect.source,
        "interaction": effect.interaction,
        "rate": effect.rate,
        "moved": _numbers(effect.position),
        "sped_up": _numbers(effect.velocity),
    }


def _numbers(values: FloatArray) -> list[float]:
    return [float(x) for x in values]
