"""Argoverse 2 sensor logs as recorded traffic: crossings that a vehicle has driven through, its own way left out.

Annotated objects stand on a common grid of 10 Hz, in coordinates about the place where the vehicle begins. Who is not
annotated, as nothing of it is within reach, is not there. Sizes are the medians of those annotated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from data_tools.datasets.argoverse2.logs import ArgoverseLogs
from saga_fg.numerics import of_classes
from saga_fg.types import VEHICLES, Annotations, Boxes

TRACED = (*VEHICLES, "pedestrian")


def argoverse_logs(root: Path) -> Recordings:
    """The logs in a folder. Raises `InputError` for a folder without any, and for a broken log."""
    logs = ArgoverseLogs(root)

    def read(name: str) -> RecordedTraffic:
        scene = logs.scene(name)
        assert scene.ground_truth is not None
        assert scene.world_T_ego is not None
        truth: list[Annotations] = list(scene.ground_truth)
        boxes = Boxes.concatenate([one.boxes for one in truth])
        ids = np.concatenate([one.id for one in truth])
        moment = np.repeat(np.rint(scene.timestamps / PERIOD).astype(np.int64), [len(one.id) for one in truth])
        kept = np.flatnonzero(of_classes(boxes.label, TRACED))
        boxes, ids, moment = boxes.select(kept), ids[kept], moment[kept]
        sizes = {}
        for one in np.unique(ids).tolist():
            rows = np.flatnonzero(ids == one)
            length, width, _ = np.median(boxes.size[rows], axis=0).tolist()
            sizes[one] = (str(boxes.label[rows[0]]), length, width)
        states = (boxes.position[:, :2] - scene.world_T_ego[0, :2, 3], np.nan_to_num(boxes.velocity), boxes.yaw)
        return on_grid(f"{root}: {name}", moment, ids, states, sizes)

    return Recordings(logs.scenes, read)
