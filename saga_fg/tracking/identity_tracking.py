"""A tracker in the place of those that number detections: `update(detections)`, as of supervision and `trackers`."""

import copy
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model import GroundCamera, Sensor
from saga_fg.numerics import IntArray, checked
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.table_tracking import UNNAMED
from saga_fg.tracking.tracker import Tracker
from saga_fg.types import Detections, Frame

D = TypeVar("D")
SENSOR = "camera"


class IdentityTracker:
    """Gives each detection of a frame the number of its track.

    camera      places image boxes on the ground; None for detections in the world
    frame_rate  frames per second, where `update` is told no times
    settings    of the tracker; by default tracks are reported from their second detection on
    sensor      the model of the detector
    classes     names by class id; the number is the name of those left out
    """

    def __init__(
        self,
        camera: GroundCamera | None = None,
        frame_rate: float = 30.0,
        settings: TrackerSettings | None = None,
        sensor: Sensor | None = None,
        classes: Mapping[int, str] | None = None,
    ) -> None:
        if not frame_rate > 0:
            raise InputError(f"frame_rate: expected a number > 0, got {frame_rate!r}")
        self.camera, self.frame_rate, self.classes = camera, frame_rate, dict(classes or {})
        self.tracker = Tracker(settings or TrackerSettings(min_hits=2), {} if sensor is None else {SENSOR: sensor})
        self._time = 0.0

    def update(self, detections: D, timestamp: float | None = None) -> D:
        """Return the detections of the next frame with the numbers of their tracks, -1 for none; timestamp: s.

        They have `xyxy` (n, 4), px, and may have `confidence` (n,) and `class_id` (n,), and are returned with
        `tracker_id` (n,), as those of supervision; or they are `saga_fg.Detections` in the world, and are returned with
        `identity`. Raises `InputError` for detections that are neither; the tracker is then as it was before.
        """
        time = self._time if timestamp is None else timestamp
        found, rows = self._placed(detections)
        name = "identity" if isinstance(detections, Detections) else "tracker_id"
        tracks = self.tracker.step(Frame(time, SENSOR, found))
        self._time = time + 1 / self.frame_rate
        id_, row = self.tracker.assignment.id, self.tracker.assignment.detection
        reported, numbers = np.isin(id_, tracks.id), np.full(len(getattr(detections, "xyxy", rows)), -1)
        numbers[rows[row[reported]]] = id_[reported]
        numbered = copy.copy(detections)
        vars(numbered)[name] = numbers
        return numbered

    def _placed(self, detections: Any) -> tuple[Detections, IntArray]:
        """Detections in the world, and their rows: image boxes are placed on the ground."""
        if isinstance(detections, Detections):
            return detections, np.arange(len(detections))
        if self.camera is None or not hasattr(detections, "xyxy"):
            expected = (
                "detections with xyxy" if self.camera is not None else "saga_fg.Detections, as there is no camera"
            )
            raise InputError(f"detections: expected {expected}, got {type(detections).__name__}")
        xyxy = checked("xyxy", detections.xyxy, (None, 4))
        score, class_id = (getattr(detections, name, None) for name in ("confidence", "class_id"))
        score = np.ones(len(xyxy)) if score is None else checked("confidence", score, (len(xyxy),))
        numbers = [] if class_id is None else checked("class_id", class_id, (len(xyxy),)).astype(np.int64).tolist()
        names = [UNNAMED] * len(xyxy) if class_id is None else [self.classes.get(k, str(k)) for k in numbers]
        label = np.array(names, dtype=np.str_)
        return self.camera.detections(xyxy, score, label)
