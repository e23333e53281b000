"""Ground truth as annotators would give it.

Annotators who see a whole recording label an object from the first moment they see it to the last, also where it is
hidden in between, unless it stays hidden for long. So an object is annotated at the keyframes at which some sensor
sees enough of it, and where it is hidden for a while between two of these, always within the annotation range.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.sensors import in_view, viewpoint
from data_tools.simulator.settings import SimulatorSettings
from data_tools.simulator.world import World
from saga_fg.arrays import BoolArray, FloatArray
from saga_fg.dataset import Annotations


def annotate(
    world: World, time: FloatArray, world_T_ego: FloatArray, settings: SimulatorSettings
) -> tuple[Annotations, ...]:
    """Ground truth at the keyframes `time` (K,), s, with the poses of the vehicle (K, 4, 4)."""
    moments = [world.objects.at(moment)[0] for moment in time]
    visible = np.zeros((len(time), len(world.objects)), dtype=np.bool_)
    near = np.zeros_like(visible)
    for k, (moment, pose, boxes) in enumerate(zip(time, world_T_ego, moments, strict=True)):
        near[k] = np.linalg.norm(boxes.position[:, :2] - pose[:2, 3], axis=1) <= settings.annotation_range
        for sensor in settings.sensors.values():
            _, reached, share = world.seen_from(viewpoint(sensor, pose), moment, sensor.max_range)
            seen = np.zeros(len(boxes), dtype=np.bool_)
            seen[reached] = share >= settings.visible_share
            visible[k] |= seen & in_view(sensor, pose, boxes.position)
    visible &= near
    annotated = near & bridged(time, visible, settings.longest_gap)
    return tuple(
        Annotations(world.objects.id[rows], boxes.select(rows), visible[k, rows])
        for k, (boxes, rows) in enumerate(zip(moments, annotated, strict=True))
    )


def bridged(time: FloatArray, visible: BoolArray, longest: float) -> BoolArray:
    """Where objects (K, N) are visible, or hidden between two sightings at most `longest` s apart; time (K,), s."""
    seen = np.where(visible, time[:, None], np.nan)
    before = np.fmax.accumulate(seen, axis=0)
    after = np.fmin.accumulate(seen[::-1], axis=0)[::-1]
    return np.asarray(after - before <= longest + 1e-9)
