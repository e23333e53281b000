"""Which true object each detection of a scene is of: material to learn from, not for tracking."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from saga_fg.learning import Sightings, match_to_truth
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Scene
from saga_fg.types.sensor import Sensor, sensor_model


def sightings(
    scene: Scene, sensors: Mapping[str, Sensor], gate: float = 2.0, step: float = 0.05
) -> dict[str, dict[str, Sightings]]:
    """Class -> object -> what the sensors measured of it, by the nearest detection of the class within `gate` m.

    Of sightings of one object closer in time than `step` s only the first is taken. Noise is that of the sensors'
    models. Raises `InputError` for a scene without ground truth.
    """
    found: dict[str, dict[str, list[tuple[float, FloatArray, FloatArray]]]] = {}
    for matched in match_to_truth(scene, sensors, gate):
        frame, truth = matched.frame, matched.annotations
        sensor = sensor_model(sensors, frame.sensor)
        time = frame.timestamp + sensor.time_offset
        R = sensor.detection_covariance(matched.detections, matched.origin)
        for j, i in zip(matched.detection.tolist(), matched.truth.tolist(), strict=True):
            rows = found.setdefault(str(truth.boxes.label[i]), {}).setdefault(str(truth.id[i]), [])
            if not rows or time - rows[-1][0] >= step:
                rows.append((time, matched.detections.boxes.position[j, :2], R[j]))
    return {
        label: {name: Sightings(*map(np.array, zip(*rows, strict=True))) for name, rows in objects.items()}
        for label, objects in found.items()
    }
