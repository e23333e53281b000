"""A journal of a tracker: an event for every track and frame with the reasons, as values that JSON can hold.

    initiated  detection and its probability, and the nearest tracks that did not take it
    matched    candidates with their squared distances in sigmas, the chosen one, and why the others were not chosen
    missed     candidates, none of which was chosen
    unsettled  in frames for which the solver found no minimum of the graph, as far as the track is concerned
    deleted    time without a detection, existence, and the limit that was passed
    clocks     offsets of the sensors' clocks, whenever one is corrected anew, or its frames are left out or used again
    graph      running graph of the interval that the frame ended (`saga_fg.tracking.graph_record`), once a frame

`matched` and `missed` also list the edges that acted on the prediction, and the effect of each. Positions are in world
coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import gate, mahalanobis
from saga_fg.tracking.class_belief import ClassGroups
from saga_fg.tracking.edge_effects import EdgeEffect, edge_effects
from saga_fg.tracking.graph_record import graph_of_frame
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.observer import Stage, TrackerView
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.types.by_class import class_settings

Event = dict[str, Any]
LISTED = 5  # candidates of an event
NEAR = 4.0  # candidates up to this multiple of the gate, as a squared distance, are listed


class Journal:
    """An observer that hands one event for each track and frame to `write`. `settings` are the tracker's."""

    def __init__(self, settings: TrackerSettings, write: Callable[[Event], None]) -> None:
        self._settings, self._write = settings, write
        self._groups = ClassGroups(settings.class_groups)
        self._before: TrackerView | None = None  # at the end of the frame before
        self._predicted: TrackerView | None = None
        self._matched: TrackerView | None = None
        self._effects: list[EdgeEffect] = []
        self._start: float | None = None
        self._clocks: dict[str, tuple[float, str]] = {}

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
            self._write_handovers(now)
            self._write_initiations(now)
        elif stage == "delete":
            now = view()
            self._write_unsettled(now)
            self._write_deletions(now)
            self._write_clocks(now)
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
        """Detections near a track, of its class or group, the nearest first."""
        assert self._predicted is not None
        label = str(self._predicted.table.label[row])
        settings = class_settings(self._settings.classes, ClassSettings, label)
        rows = np.flatnonzero(self._groups.same_group(np.array([label]), measurements.boxes.label)[0])
        measured = measurements.boxes.position[rows, :2]
        d2, _ = mahalanobis(position[None], self._predicted.P[row][None], measured, measurements.R[rows, :2, :2])
        apart, limit = np.hypot(*(measured - position).T), gate(settings.gate)
        near = [k for k in np.argsort(d2[0]).tolist() if d2[0, k] < NEAR * limit or rows[k] == chosen][:LISTED]
        result = []
        for k in near:
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

    def _write_handovers(self, now: TrackerView) -> None:
        last = self._matched
        assert last is not None
        for row in np.flatnonzero(~np.isin(last.table.id, now.table.id)).tolist():
            event = self._event("deleted", last, int(last.table.id[row]), row)
            coasting, existence = 0.0, float(last.table.existence[row])
            reason = "it is the return of an earlier track"
            self._write(event | {"coasting": coasting, "existence": existence, "reason": reason})

    def _write_deletions(self, now: TrackerView) -> None:
        last, settings = self._before, self._settings
        assert last is not None
        for row in np.flatnonzero(~np.isin(last.table.id, now.table.id)).tolist():
            event = self._event("deleted", last, int(last.table.id[row]), row)
            coasting = float(last.timestamp - last.table.last_detected[row])
            existence = float(last.table.existence[row])
            if coasting > settings.max_coasting:
                reason = f"not detected for longer than {settings.max_coasting:g} s"
            elif not last.table.confirmed[row] and existence < settings.existence.delete_below:
                reason = f"existence below {settings.existence.delete_below:g} before it was confirmed"
            elif coasting > 0:
                reason = "its place is no longer known well enough to report it or to find it again"
            else:
                reason = "another track took its place"
            self._write(event | {"coasting": coasting, "existence": existence, "reason": reason})

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
