"""The road of a scene as the page's player wants it: lanes, stop lines and lights that its frames brought along.

    road  {"lanes": [[width, x, y, x, y, ...]], "lines": [[light, x, y, x, y]], "lights": [[x, y]],
           "colours": [[colour of each light]]}, or null where no frame brought a map

Lengths in cm about the scene's start; lights are counted from 0. A colour is 0 red, 1 amber, 2 green
(`saga_fg.model.road.COLOURS`), the one last reported at or before the moment; null before the first report. A report is
of the light nearest to it, or of none if that is further than `SignalSettings.max_distance` is by default.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from data_tools.datasets.area_map import AreaMap
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame
from saga_fg.types.road_map import Lane, StopLine, TrafficLight
from saga_fg.types.signal import COLOUR_LABELS, MAX_LIGHT_DISTANCE

Colours = list[list[int | None]]


def road_data(frames: Iterable[Frame], detections: Sequence[Boxes], origin: FloatArray) -> dict[str, Any] | None:
    """Return the data of the road, ready for JSON; see the module's docstring.

    detections  of each moment, in world coordinates and in order of time
    origin      (2,) place of the scene's start, m
    """
    lanes: dict[str, Lane] = {}
    lines: dict[str, StopLine] = {}
    lights: dict[str, TrafficLight] = {}
    maps = {id(frame.road_map): frame.road_map for frame in frames if frame.road_map is not None}  # most bring the same
    for known in maps.values():
        for light in known.lights:  # the first entry of a name stays, as in the tracker
            lights.setdefault(light.name, light)
        for line in known.stop_lines:
            lines.setdefault(line.name, line)
        for lane in known.lanes:
            lanes.setdefault(lane.name, lane)
    if not lanes and not lights:
        return None
    number = {name: k for k, name in enumerate(lights)}
    places = np.array([light.position for light in lights.values()]).reshape(-1, 2)
    return {
        "lanes": [[round(100 * lane.width), *_centimetres(lane.centre, origin)] for lane in lanes.values()],
        "lines": [[number[line.light], *_centimetres(line.ends, origin)] for line in lines.values()],
        "lights": [_centimetres(place, origin) for place in places],
        "colours": _colours(places, detections),
    }


def map_data(known: AreaMap, origin: FloatArray) -> dict[str, Any]:
    """Return areas and lines, ready for JSON, in cm about the scene's start."""
    return {
        "areas": [[kind, *(_centimetres(ring, origin) for ring in rings)] for kind, rings in known.areas],
        "lines": [_centimetres(line, origin) for line in known.lines],
    }


def _colours(lights: FloatArray, detections: Sequence[Boxes]) -> Colours:
    """Return for each moment the colour last reported of each light; lights (L, 2)."""
    reach = MAX_LIGHT_DISTANCE
    now: list[int | None] = [None] * len(lights)
    colours = []
    for boxes in detections:
        reported = boxes.select(np.flatnonzero(np.isin(boxes.label, COLOUR_LABELS)))
        if len(lights) and len(reported):
            now = now.copy()
            apart = np.linalg.norm(reported.position[:, None, :2] - lights, axis=2)
            nearest = apart.argmin(axis=1)
            for label, light, far in zip(reported.label, nearest.tolist(), apart.min(axis=1), strict=True):
                if far < reach:
                    now[light] = COLOUR_LABELS.index(str(label))
        colours.append(now)
    return colours


def _centimetres(points: Any, origin: FloatArray) -> list[int]:
    """Return points (..., 2), flattened."""
    flat: list[float] = (100 * (np.asarray(points) - origin)).ravel().tolist()
    return [round(value) for value in flat]
