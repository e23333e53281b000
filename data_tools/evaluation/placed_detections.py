"""The detections of a scene at its moments, as the metrics compare them with labels."""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import IntArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene

PlacedBoxes = tuple[IntArray, Boxes]
"""(moment (N,), boxes (N))"""


def placed_detections(scene: Scene) -> PlacedBoxes:
    """The boxes of all frames that were taken at a moment of the scene, in the frames' coordinates (world)."""
    moment_of = {time: k for k, time in enumerate(scene.timestamps.tolist())}
    frames = [(moment_of[frame.timestamp], frame) for frame in scene.frames if frame.timestamp in moment_of]
    moment = np.repeat(np.array([k for k, _ in frames], dtype=np.int64), [len(frame) for _, frame in frames])
    return moment, Boxes.concatenate([frame.detections.boxes for _, frame in frames])
