"""Which objects are part of the ground truth, and when.

An object within the annotation range is annotated while some sensor sees enough of it, and for as long afterwards as a
tracker may be asked to remember it, whether it comes into view again or not. It counts as visible where such a view
lasts; after a mere glimpse nobody can be expected to know how it moves.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.sensors import in_view, viewpoint
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import World
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.dataset import Annotations


def annotate(
    world: World, time: FloatArray, world_T_ego: FloatArray, settings: SimulatorSettings
) -> tuple[Annotations, ...]:
    """Ground truth at the keyframes `time` (K,), s, with the poses of the vehicle (K, 4, 4)."""
    moments, present = zip(*(world.objects.at(moment) for moment in time), strict=True)
    near, visible = np.zeros((2, len(time), len(world.objects)), dtype=np.bool_)
    for k, (moment, pose, boxes) in enumerate(zip(time, world_T_ego, moments, strict=True)):
        distance = np.linalg.norm(boxes.position[:, :2] - pose[:2, 3], axis=1)
        near[k] = present[k] & (distance <= settings.annotation_range)
        for sensor in settings.sensors.values():
            _, reached, share = world.seen_from(viewpoint(sensor, pose), moment, sensor.max_range)
            seen = np.zeros(len(boxes), dtype=np.bool_)
            seen[reached] = share >= settings.visible_share
            visible[k] |= seen & in_view(sensor, pose, boxes.position)
    visible &= near
    annotated = near & remembered(time, visible, settings.memory)
    visible = lasting(visible, round(settings.shortest_view * settings.keyframe_rate))
    return tuple(
        Annotations(world.objects.id[rows], boxes.select(rows), visible[k, rows])
        for k, (boxes, rows) in enumerate(zip(moments, annotated, strict=True))
    )


def lasting(visible: BoolArray, shortest: int) -> BoolArray:
    """`visible` (K, N) without the runs along the first axis of less than `shortest` moments."""
    length = np.zeros(visible.shape, dtype=np.int64)  # of each run, up to here and then altogether
    for k in range(len(visible)):
        length[k] = np.where(visible[k], (length[k - 1] if k else 0) + 1, 0)
    for k in range(len(visible) - 2, -1, -1):
        length[k] = np.where(visible[k] & visible[k + 1], length[k + 1], length[k])
    return np.asarray(visible & (length >= shortest))


def remembered(time: FloatArray, visible: BoolArray, memory: float) -> BoolArray:
    """Where objects (K, N) are visible or were so at most `memory` s ago; time (K,), s."""
    seen = np.where(visible, time[:, None], -np.inf)
    return np.asarray(time[:, None] - np.maximum.accumulate(seen, axis=0) <= memory + 1e-9)
