"""The online pass of offline smoothing: a tracker over all frames, and which detections its tracks rest on."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipelines.tracking import OnlineTracker, Progress
from saga_fg.arrays import IntArray
from saga_fg.dataset import Scene
from saga_fg.sensor import Sensor
from saga_fg.smoothing.attribution import attribute
from saga_fg.smoothing.evidence import Evidence, measured_in_order
from saga_fg.tracking.settings import ClassSettings, class_values

UPDATED_GATE = 1 - 1e-12  # wide: the tracker has matched them already, perhaps by other models of the noise


def track_evidence(
    scene: Scene,
    tracker: OnlineTracker,
    evidence: Evidence,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
    progress: Progress | None = None,
) -> IntArray:
    """(N,) the track of each detection, -1 for none: of the reported tracks that a frame updated, the likely one."""
    track_of = np.full(len(evidence), -1, dtype=np.int64)
    frames = measured_in_order(scene.frames, sensors)
    for count, ((_, frame), rows) in enumerate(zip(frames, evidence.rows_of_look(), strict=True)):
        tracks = tracker.step(frame)
        updated = tracks.select(tracks.coasting == 0)
        noise = evidence.R[rows, :2, :2]
        objects, detections = attribute(
            updated.boxes.label,
            updated.boxes.position[:, :2] - evidence.origin,
            updated.position_covariance,
            evidence.boxes.label[rows],
            evidence.boxes.position[rows, :2],
            noise,
            UPDATED_GATE,
            class_values(classes, "max_distance", updated.boxes.label),
        )
        track_of[rows.start + detections] = updated.id[objects]
        if progress is not None:
            progress(scene.name, count + 1, len(frames))
    return track_of
