"""The labelled objects of a recording over its moments, and which detections are of which object.

A detection is of the nearest labelled object, of its class, if that is within `REACH`. So a duplicate beside the
neighbour of a hidden object is the neighbour's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.sensor import Sensor, sensor_model
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame
from saga_fg.types.labelled_objects import LabelledObjects

REACH = 2.0  # m, from an object to its detections


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """N objects at the K moments of a scene, NaN where they are not labelled.

    id, label (N,); position (K, N, 2), m, world; detected (K, N) whether some detection is of the object
    velocity  (K, N, 2), m/s, world, by differences of positions where the labels have none; yaw (K, N), rad
    owner     for each frame, the object (D,) that each detection is of, whatever its class; -1: none
    boxes     for each frame, its detections in the world
    """

    scene: Scene
    id: StrArray
    label: StrArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    detected: BoolArray
    owner: tuple[IntArray, ...]
    boxes: tuple[Boxes, ...]

    @classmethod
    def of(cls, scene: Scene, sensors: Mapping[str, Sensor]) -> LabelledScene:
        """Raises `InputError` for a scene without ground truth or detections."""
        if scene.ground_truth is None or not scene.frames:
            missing = "detections" if scene.ground_truth is not None else "ground truth"
            raise InputError(f"scene {scene.name}: expected {missing} to find gaps in, there are none")
        truth = scene.ground_truth
        objects = LabelledObjects.of(scene)
        rows = [np.searchsorted(objects.id, moment.id) for moment in truth]
        detected = np.zeros((len(truth), len(objects.id)), dtype=np.bool_)
        owners, found = [], []
        for frame in scene.frames:
            k = int(np.argmin(np.abs(scene.timestamps - frame.timestamp)))
            boxes = sensor_model(sensors, frame.sensor).in_world(frame).boxes
            distance = _distances(boxes, truth[k], frame.timestamp - float(scene.timestamps[k]))
            owners.append(_nearest(distance, rows[k]))
            found.append(boxes)
            distance[boxes.label[:, None] != truth[k].boxes.label] = np.inf
            same = _nearest(distance, rows[k])
            detected[k, same[same >= 0]] = True
        position, velocity = objects.position, objects.velocity
        velocity = np.where(np.isfinite(velocity), velocity, _differences(position, scene.timestamps))
        about = objects.id, objects.label, position, velocity, objects.heading
        return cls(scene, *about, detected, tuple(owners), tuple(found))

    def frames_without(self, row: IntArray, start: FloatArray, stop: FloatArray) -> list[Frame]:
        """The frames without the detections of objects `row` (W,) after `start` and before `stop` (W,), s."""
        kept = []
        for frame, owner in zip(self.scene.frames, self.owner, strict=True):
            hidden = row[(start < frame.timestamp - 1e-6) & (frame.timestamp + 1e-6 < stop)]
            gone = np.isin(owner, hidden)
            kept.append(replace(frame, detections=frame.detections.select(~gone)) if gone.any() else frame)
        return kept


def _differences(position: FloatArray, time: FloatArray) -> FloatArray:
    """(K, N, 2) m/s from the moment before, or to the one after where that is not labelled."""
    step = np.diff(position, axis=0) / np.diff(time)[:, None, None]
    nothing = np.full((1, *position.shape[1:]), np.nan)
    before, after = np.concatenate([nothing, step]), np.concatenate([step, nothing])
    return np.where(np.isfinite(before), before, after)


def _distances(boxes: Boxes, truth: Annotations, elapsed: float) -> FloatArray:
    """(D, M), m, from detections to labelled objects, moved on by `elapsed` s."""
    there = truth.boxes.position[:, :2] + np.nan_to_num(truth.boxes.velocity) * elapsed
    offset = boxes.position[:, None, :2] - there
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def _nearest(distance: FloatArray, rows: IntArray) -> IntArray:
    """(D,) the object of `rows` (M,) that is nearest to each detection, -1 where none is within reach."""
    if distance.shape[1] == 0:
        return np.full(len(distance), -1, dtype=np.int64)
    nearest = distance.argmin(axis=1)
    within = distance[np.arange(len(distance)), nearest] <= REACH
    return np.where(within, rows[nearest], -1)
