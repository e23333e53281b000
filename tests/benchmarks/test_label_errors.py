"""Errors of labels against the truth of their scene."""

import numpy as np

from benchmarks.labels import judged
from saga_fg.smoothing import LabelBuilder, LabelModel
from saga_fg.tracking import Tracker, TrackerSettings
from saga_fg.types import Annotations, Boxes, Detections, Frame, Scene

N, DT, ANNOTATED = 40, 0.25, 28  # frames, s, first frame in which the far car is annotated


def boxes(label: list[str], position: list[tuple[float, float]]) -> Boxes:
    n = len(label)
    places = np.column_stack([np.array(position), np.zeros(n)])
    return Boxes.of(label, places, np.tile([4.5, 1.9, 1.6], (n, 1)), np.zeros(n), np.full((n, 2), np.nan))


def recording() -> Scene:
    """Detections of three cars: one is annotated late, one is truly a van, one is none, past which a cyclist rides."""
    frames, truth = [], []
    for k in range(N):
        far, van, none = (80.0 - k, 0.0), (k * 1.0, 20.0), (10.0, 40.0)
        frames.append(Frame(k * DT, "lidar", Detections(boxes(["car"] * 3, [far, van, none]), np.full(3, 0.9))))
        label, id_, places = ["van", "cyclist"], ["v", "b"], [van, (10.0 + k - 20, 40.0)]
        if k >= ANNOTATED:
            label, id_, places = [*label, "car"], [*id_, "c"], [*places, far]
        truth.append(Annotations(np.array(id_), boxes(label, places)))
    return Scene("drive", np.arange(N) * DT, frames=frames, ground_truth=truth)


def test_an_object_seen_before_it_is_annotated_is_not_false():
    scene, settings = recording(), TrackerSettings(min_hits=2)
    builder = LabelBuilder(Tracker(settings), LabelModel(settings))
    builder.add(scene.frames, scene.timestamps)
    now = judged(scene, [moment for part in builder.finish()[0] for moment in part])
    found = {round(float(now.found.boxes.position[rows[0], 1]), -1): rows for rows in now.tracks().values()}
    far, van, none = found[0.0], found[20.0], found[40.0]
    assert (now.any[far] >= 0).mean() < 0.5  # of all its boxes
    assert [now.is_false(rows) for rows in (far, van, none)] == [False, False, True]
    assert [now.is_class(rows) for rows in (far, van, none)] == [True, False, False]
    assert [now.is_other_class(rows) for rows in (far, van, none)] == [False, True, False]
