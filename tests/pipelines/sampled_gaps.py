"""Objects that drive straight on and are hidden for a while, and short simulated scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from data_tools.simulator import SimulatorSettings
from saga_fg import Annotations, Boxes, Detections, Frame, Scene, Tracks
from saga_fg.learning.labelled_scene import LabelledScene

SHORT = replace(SimulatorSettings(), duration=12.0, warm_up=5.0)
TIMES = 0.5 * np.arange(16)
SPEED = 2.0  # m/s
Places = Mapping[str, Sequence[float | None]]
"""x of each object or track at each moment, m; None where it is not there."""


def boxes(x: Sequence[float]) -> Boxes:
    return Boxes.of(["car"] * len(x), [[each, 0.0, 1.0] for each in x], velocity=[[SPEED, 0.0]] * len(x))


def scene(labels: Places, detections: Places) -> Scene:
    """Labels at all moments, and a frame of detections at each."""
    truth, frames = [], []
    for k, time in enumerate(TIMES.tolist()):
        there = {name: x[k] for name, x in labels.items() if x[k] is not None}
        truth.append(
            Annotations(np.array(list(there), dtype=np.str_), boxes(list(there.values())), np.ones(len(there), bool))
        )
        seen = [x[k] for x in detections.values() if x[k] is not None]
        frames.append(Frame(time, "lidar", Detections(boxes(seen), np.ones(len(seen)))))
    poses = np.tile(np.eye(4), (len(TIMES), 1, 1))
    return Scene("drawn", TIMES, poses, ("",) * len(TIMES), frames, truth)


def tracks(places: Places, detected: Mapping[str, Sequence[bool]]) -> list[Tracks]:
    """Tracks named by numbers, and whether each has a detection at each moment."""
    found, last = [], dict.fromkeys(places, 0.0)
    for k, time in enumerate(TIMES.tolist()):
        there = {name: x[k] for name, x in places.items() if x[k] is not None}
        last |= {name: time for name in there if detected[name][k]}
        n = len(there)
        wide = np.tile(np.eye(2), (n, 1, 1))
        coasting = np.array([time - last[name] for name in there])
        ids = np.array([int(name) for name in there], dtype=np.int64)
        found.append(Tracks(time, ids, boxes(list(there.values())), np.ones(n), wide, wide, coasting))
    return found


def straight(start: float = 0.0) -> list[float]:
    return (start + SPEED * TIMES).tolist()


def without(x: Sequence[float], gone: range) -> list[float | None]:
    return [None if k in gone else each for k, each in enumerate(x)]


HIDDEN = range(5, 9)  # 2.5 to 4 s: the last detection is at 2 s, the next at 4.5 s
SEEN = [k not in HIDDEN for k in range(len(TIMES))]


def labelled(labels: Places, detections: Places) -> LabelledScene:
    return LabelledScene.from_scene(scene(labels, detections), {})
