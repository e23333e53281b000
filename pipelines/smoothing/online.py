"""The online pass of offline smoothing: a tracker over all frames, and which detections its tracks rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipelines.tracking import OnlineTracker, Progress
from saga_fg.numerics.arrays import IntArray
from saga_fg.smoothing.attribution import attribute
from saga_fg.smoothing.evidence import Evidence, measured_in_order
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types.by_class import class_values
from saga_fg.types.frame import Frame
from saga_fg.types.sensor import Sensor

UPDATED_GATE = 1 - 1e-12  # wide: the tracker has matched them already, perhaps by other models of the noise


def track_evidence(
    name: str,
    frames: Sequence[Frame],
    tracker: OnlineTracker,
    evidence: Evidence,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
    progress: Progress | None = None,
) -> IntArray:
    """(N,) the track of each detection, -1 for none: of the reported tracks that a frame updated, the likely one.

    evidence: that of these frames, or of the next ones of a recording; `name` of the recording, for `progress`
    """
    track_of = np.full(len(evidence), -1, dtype=np.int64)
    ordered = measured_in_order(frames, sensors)
    for count, ((_, frame), rows) in enumerate(zip(ordered, evidence.rows_of_look(), strict=True)):
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
            class_values(classes, ClassSettings, updated.boxes.label, "max_distance")[0],
        )
        track_of[rows.start + detections] = updated.id[objects]
        if progress is not None:
            progress(name, count + 1, len(ordered))
    return track_of
