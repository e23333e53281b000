"""Who is affected, at a moment, by what is not a moving object: ids of the vehicles concerned, as the truth knows them.

What happens later plays no part: a vehicle that comes to a closed light counts, whether it will brake, stop or pass.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.world import World
from saga_fg.numerics.arrays import BoolArray, StrArray

MOVING = 0.5  # m/s
REACH = 100.0  # m before a stop line
HORIZON = 3.0  # s: whoever will be at the taper within this time


def affected(world: World, time: float) -> StrArray:
    """Ids of moving objects affected at `time`, s, by a closed light, by cones, or by what they are attached to."""
    boxes, present = world.objects.at(time)
    ids = world.objects.id
    moving = present & (np.hypot(*np.nan_to_num(boxes.velocity).T) > MOVING)
    vehicles = _before_lights(world, time) | _at_cones(world, time)
    kinds = np.char.partition(ids, "-")
    kind, number = kinds[:, 0], kinds[:, 2]
    named = (kind == "vehicle") & vehicles[np.where(kind == "vehicle", number, "0").astype(np.int64)]
    towed = np.isin(kind, ("vehicle", "trailer")) & np.isin(number, number[kind == "trailer"])
    return np.asarray(ids[moving & (named | towed | np.isin(kind, ("bicycle", "rider")))])


def _before_lights(world: World, time: float) -> BoolArray:
    """Which vehicles (N,) have a closed stop line within reach before them."""
    history, k = world.history, _moment(world, time)
    concerned = np.zeros(history.s.shape[1], dtype=np.bool_)
    for line in world.layout.stop_lines:
        if line.closed(time):
            way = line.s - history.s[k] - world.layout.fleet.length / 2
            concerned |= np.isin(history.lane[k], line.lanes) & (way > 0) & (way < REACH)
    return np.asarray(concerned & history.on_road[k])


def _at_cones(world: World, time: float) -> BoolArray:
    """Which vehicles (N,) come to a taper or are in it, or are the next behind such a one in the lane it joins."""
    history, k, lanes = world.history, _moment(world, time), world.layout.lanes
    lane, s, on_road = history.lane[k], history.s[k], history.on_road[k]
    if lanes.taper == 0:
        return np.zeros(len(s), dtype=np.bool_)
    begin = lanes.end - lanes.taper - HORIZON * history.speed[k]
    pushed = on_road & (lane == lanes.ending) & (s >= begin)
    concerned = pushed.copy()
    beside = np.flatnonzero(on_road & (lane == lanes.adjacent))
    for row in np.flatnonzero(pushed).tolist():
        behind = beside[s[beside] < s[row]]
        if len(behind):
            concerned[behind[np.argmax(s[behind])]] = True
    return np.asarray(concerned)


def _moment(world: World, time: float) -> int:
    return int(np.argmin(np.abs(world.history.time - time)))
