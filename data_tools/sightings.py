"""Which true object each detection of a scene is of: material to learn from, not for tracking."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saga_fg.arrays import FloatArray, StrArray
from saga_fg.association import assign
from saga_fg.dataset import Scene
from saga_fg.errors import InputError
from saga_fg.learning import Sightings
from saga_fg.sensor import Sensor, sensor_model


def sightings(
    scene: Scene, sensors: Mapping[str, Sensor], gate: float = 2.0, step: float = 0.05
) -> dict[str, dict[str, Sightings]]:
    """Class -> object -> what the sensors measured of it, by the nearest detection of the class within `gate` m.

    True places between two moments are interpolated. Of sightings of one object closer in time than `step` s only the
    first is taken. Noise is that of the sensors' models; detections must be in world coordinates. Raises `InputError`
    for a scene without ground truth.
    """
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth")
    found: dict[str, dict[str, list[tuple[float, FloatArray, FloatArray]]]] = {}
    for frame in scene.frames:
        k = int(np.searchsorted(scene.timestamps, frame.timestamp - 1e-9))
        if k >= len(scene) or (k == 0 and frame.timestamp < scene.timestamps[0] - 1e-6):
            continue
        labels, ids, place = _truth_at(scene, k, frame.timestamp)
        sensor = sensor_model(sensors, frame.sensor)
        boxes = frame.detections.boxes
        origin = np.zeros(2) if frame.world_T_ego is None else frame.world_T_ego[:2, 3]
        p = sensor.probability(frame.detections.score)
        R = sensor.position_covariance(boxes.label, boxes.position[:, :2], p, origin)
        distance = np.hypot(*np.moveaxis(boxes.position[None, :, :2] - place[:, None], -1, 0))
        possible = (labels[:, None] == boxes.label[None]) & (distance < gate)
        for i, j in zip(*assign(distance, possible, gate), strict=True):
            rows = found.setdefault(str(labels[i]), {}).setdefault(str(ids[i]), [])
            if not rows or frame.timestamp - rows[-1][0] >= step:
                rows.append((frame.timestamp, boxes.position[j, :2], R[j]))
    return {
        label: {name: Sightings(*map(np.array, zip(*rows, strict=True))) for name, rows in objects.items()}
        for label, objects in found.items()
    }


def _truth_at(scene: Scene, k: int, timestamp: float) -> tuple[StrArray, StrArray, FloatArray]:
    """Labels (n,), ids (n,) and places (n, 2) of the true objects at a time between moments k - 1 and k."""
    assert scene.ground_truth is not None
    after = scene.ground_truth[k]
    place = after.boxes.position[:, :2].copy()
    if k > 0 and timestamp < scene.timestamps[k]:
        before = scene.ground_truth[k - 1]
        share = (scene.timestamps[k] - timestamp) / (scene.timestamps[k] - scene.timestamps[k - 1])
        _, new, old = np.intersect1d(after.id, before.id, return_indices=True)
        place[new] += share * (before.boxes.position[old, :2] - place[new])
    return after.boxes.label, after.id, place
