"""Cones that close a lane: a straight taper from its outer to its inner border, then a row along the inner one."""

from __future__ import annotations

import numpy as np

from data_tools.simulator.lanes import Lanes
from data_tools.simulator.settings import RoadworkSettings
from saga_fg.types.boxes import Boxes

CONE = (0.45, 0.45, 0.75)  # length, width, height, m
SCATTER = 0.1  # standard deviation of a cone's place, m


def draw_cones(lanes: Lanes, settings: RoadworkSettings, rng: np.random.Generator) -> Boxes:
    """The cones that close the ending lane; none where it is not closed by cones."""
    if lanes.taper == 0:
        return Boxes.empty()
    inner = (lanes.offset[lanes.ending] + lanes.offset[lanes.beside]) / 2
    outer = 2 * lanes.offset[lanes.ending] - inner
    end = lanes.end + rng.uniform(*settings.row)
    s = np.arange(lanes.end - lanes.taper, end, settings.spacing)
    d = np.interp(s, [lanes.end - lanes.taper, lanes.end], [outer, inner])
    n = len(s)
    place = lanes.road.position(s, d) + SCATTER * rng.standard_normal((n, 2))
    position = np.column_stack([place, np.full(n, CONE[2] / 2)])
    size = np.tile(np.array(CONE), (n, 1))
    return Boxes(np.full(n, "traffic_cone"), position, size, np.zeros(n), np.zeros((n, 2)))
