"""A journal of a tracker: for every track and frame what happened to it, and why, as events that JSON can hold.

    born     from which detection, how probable, and which tracks were near but did not take it
    matched  the candidates with their squared distances in sigmas, which was chosen, why the others were not
    missed   the same with none chosen
    ended    how long unseen, how much believed, and which limit was passed
    graph    the running graph of the interval that the frame ended (`saga_fg.tracking.graph_record`), once a frame

`matched` and `missed` also say which edges acted on the prediction, and what each contributed. Positions are in world
coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import gate, mahalanobis
from saga_fg.tracking.class_belief import ClassGroups
from saga_fg.tracking.edge_effects import EdgeEffect, edge_effects
from saga_fg.tracking.graph_record import graph_of_frame
from saga_fg.tracking.observation import Observed
from saga_fg.tracking.observer import Stage, TrackerView
from saga_fg.tracking.settings import ClassSettings, TrackerSettings
from saga_fg.types.by_class import class_settings

Event = dict[str, Any]
LISTED = 5  # candidates of an event
NEAR = 4.0  # how many times the gate, as a squared distance, a candidate may be away to be worth a word


class Journal:
    """An observer that hands one event for each track and frame to `write`. `settings` are the tracker's."""

    def __init__(self, settings: TrackerSettings, write: Callable[[Event], None]) -> None:
        self._settings, self._write = settings, write
        self._groups = ClassGroups(settings.class_groups)
        self._before: TrackerView | None = None  # at the end of the frame before
        self._predicted: TrackerView | None = None
        self._effects: list[EdgeEffect] = []
        self._start: float | None = None

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Take note of a stage."""
        if stage == "predict":
            self._predicted = view()
            self._effects = self._edge_effects(self._predicted)
        elif stage == "believe":
            self._tell_matches(view())
        elif stage == "births":
            now = view()
            self._start = now.timestamp if self._start is None else self._start
            graph = graph_of_frame(self._before, now, self._start)
            self._write({"event": "graph", "time": now.timestamp, "sensor": now.sensor, **graph})
            self._before = now
            self._tell_births(now)
        elif stage == "deaths":
            now = view()
            self._tell_deaths(now)
            self._before = now

    def _edge_effects(self, now: TrackerView) -> list[EdgeEffect]:
        before = self._before
        if before is None or now.graph is None or now.timestamp <= before.timestamp:
            return []
        return edge_effects(now.graph, now.timestamp - before.timestamp, before.nodes)

    def _tell_matches(self, now: TrackerView) -> None:
        assert self._predicted is not None
        assert now.observed is not None
        assert now.matching is not None
        taken = dict(zip(now.matching.detection.tolist(), now.columns.id[now.matching.track].tolist(), strict=True))
        chosen = dict(zip(now.matching.track.tolist(), now.matching.detection.tolist(), strict=True))
        places = self._predicted.places()
        for row, id_ in enumerate(now.columns.id.tolist()):
            detection = chosen.get(row)
            event = self._event("missed" if detection is None else "matched", now, id_, row)
            event["predicted"] = _numbers(places[row])
            event["deviation"] = _numbers(np.sqrt(np.diagonal(self._predicted.P[row])))
            event["candidates"] = self._candidates(row, places[row], now.observed, taken, detection)
            if detection is not None:
                event["position"] = _numbers(now.places()[row])
            event["existence"] = [float(view.columns.existence[row]) for view in (self._predicted, now)]
            event["unseen"] = float(now.timestamp - now.columns.last_seen[row])
            event["edges"] = [_edge(effect) for effect in self._effects if effect.target == id_]
            self._write(event)

    def _candidates(
        self, row: int, place: FloatArray, observed: Observed, taken: dict[int, int], chosen: int | None
    ) -> list[Event]:
        """The detections of the class, or its group, that come into question for a track, the nearest first."""
        assert self._predicted is not None
        label = str(self._predicted.columns.label[row])
        settings = class_settings(self._settings.classes, ClassSettings, label)
        rows = np.flatnonzero(self._groups.akin(np.array([label]), observed.boxes.label)[0])
        measured = observed.boxes.position[rows, :2]
        d2, _ = mahalanobis(place[None], self._predicted.P[row][None], measured, observed.R[rows, :2, :2])
        apart, limit = np.hypot(*(measured - place).T), gate(settings.gate)
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
                    "detection": int(observed.row[detection]),
                    "position": _numbers(measured[k]),
                    "probability": float(observed.probability[detection]),
                    "distance2": float(d2[0, k]),
                    "gate": limit,
                    "metres": float(apart[k]),
                    "outcome": outcome,
                }
            )
        return result

    def _tell_births(self, now: TrackerView) -> None:
        assert self._predicted is not None
        assert now.observed is not None
        old = self._predicted
        for n, detection in enumerate(now.born.tolist()):
            row = len(now.columns.id) - len(now.born) + n
            event = self._event("born", now, int(now.columns.id[row]), row)
            measured = now.observed.boxes.position[detection, :2]
            same = np.flatnonzero(old.columns.label == now.columns.label[row])
            noise = now.observed.R[detection, :2, :2][None]
            d2, _ = mahalanobis(old.places()[same], old.P[same], measured[None], noise)
            nearest = same[np.argsort(d2[:, 0])[:3]]
            of_class = class_settings(self._settings.classes, ClassSettings, event["label"])
            event |= {
                "detection": int(now.observed.row[detection]),
                "position": _numbers(measured),
                "probability": float(now.observed.probability[detection]),
                "least_probability": of_class.initiation_score,
                "gate": gate(of_class.gate),
                "nearest_tracks": [
                    {"track": int(old.columns.id[k]), "distance2": float(d2[same == k, 0][0])} for k in nearest.tolist()
                ],
            }
            self._write(event)

    def _tell_deaths(self, now: TrackerView) -> None:
        last, settings = self._before, self._settings
        assert last is not None
        for row in np.flatnonzero(~np.isin(last.columns.id, now.columns.id)).tolist():
            event = self._event("ended", last, int(last.columns.id[row]), row)
            of_class = class_settings(settings.classes, ClassSettings, event["label"])
            unseen = float(last.timestamp - last.columns.last_seen[row])
            out_of_view = float(last.timestamp - last.columns.last_in_view[row])
            existence = float(last.columns.existence[row])
            if unseen > of_class.max_coasting:
                reason = f"unseen for longer than {of_class.max_coasting:g} s"
            elif out_of_view > settings.max_out_of_view:
                reason = f"outside every sensor's view for longer than {settings.max_out_of_view:g} s"
            elif existence < settings.existence.delete_below:
                reason = f"existence below {settings.existence.delete_below:g} before it was confirmed"
            else:
                reason = "another track took its place"
            self._write(event | {"unseen": unseen, "existence": existence, "reason": reason})

    def _event(self, kind: str, view: TrackerView, id_: int, row: int) -> Event:
        return {
            "event": kind,
            "time": view.timestamp,
            "sensor": view.sensor,
            "track": id_,
            "label": str(view.columns.label[row]),
            "confirmed": bool(view.columns.confirmed[row]),
        }


def of_scene(write: Callable[[Event], None], scene: str) -> Callable[[Event], None]:
    """A `write` that puts the scene's name into every event."""
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
