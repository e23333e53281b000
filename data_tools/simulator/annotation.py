"""Ground-truth annotations of a simulated scene.

An object within the annotation range is annotated while a sensor sees enough of it and for `memory` s afterwards. It
counts as visible only in views of some duration; a shorter view does not reveal its motion.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.sensed_world import SensedWorld
from data_tools.simulator.sensors import in_view, sensor_position
from data_tools.simulator.settings import SimulatorSettings
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.dataset import Annotations

VISIBLE_SHARE = 0.25  # least share of an object that a sensor must see for it to count as visible


def annotate(
    world: SensedWorld, time: FloatArray, world_T_ego: FloatArray, settings: SimulatorSettings
) -> tuple[Annotations, ...]:
    """Ground truth at the keyframes `time` (K,), s, with the poses of the vehicle (K, 4, 4)."""
    boxes_at, present = zip(*(world.objects.at(t) for t in time), strict=True)
    near, visible = np.zeros((2, len(time), len(world.objects)), dtype=np.bool_)
    for k, (t, pose, boxes) in enumerate(zip(time, world_T_ego, boxes_at, strict=True)):
        distance = np.linalg.norm(boxes.position[:, :2] - pose[:2, 3], axis=1)
        near[k] = present[k] & (distance <= settings.annotation_range)
        for sensor in settings.sensors.values():
            _, reached, share = world.visible_from(sensor_position(sensor, pose), t, sensor.max_range)
            seen = np.zeros(len(boxes), dtype=np.bool_)
            seen[reached] = share >= VISIBLE_SHARE
            visible[k] |= seen & in_view(sensor, pose, boxes.position)
    visible &= near
    annotated = near & recently_visible(time, visible, settings.memory)
    visible = without_short_runs(visible, round(settings.shortest_view * settings.keyframe_rate))
    return tuple(
        Annotations(world.objects.id[rows], boxes.select(rows), visible[k, rows])
        for k, (boxes, rows) in enumerate(zip(boxes_at, annotated, strict=True))
    )


def without_short_runs(visible: BoolArray, shortest: int) -> BoolArray:
    """`visible` (K, N) without runs along the first axis shorter than `shortest` keyframes."""
    from scipy import ndimage  # a tenth of a second, which every help of the command would pay

    return np.asarray(ndimage.binary_opening(visible, np.ones((max(shortest, 1), 1))))


def recently_visible(time: FloatArray, visible: BoolArray, memory: float) -> BoolArray:
    """Mask (K, N) of the objects that are visible or were so at most `memory` s ago; time (K,), s."""
    seen = np.where(visible, time[:, None], -np.inf)
    return np.asarray(time[:, None] - np.maximum.accumulate(seen, axis=0) <= memory + 1e-9)
