"""The interface of a world, simulated or recorded, to sensors, detectors and annotators."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from data_tools.simulator.lights import Signal
from data_tools.simulator.occlusion import visible_share
from data_tools.simulator.trajectories import SimulatedTrajectories
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.road_map import RoadMap


class SensedWorld(Protocol):
    """Objects that can be detected and annotated, lights, a map given with the frames, and a vehicle with sensors."""

    @property
    def objects(self) -> SimulatedTrajectories: ...
    @property
    def signals(self) -> tuple[Signal, ...]: ...
    @property
    def road_map(self) -> RoadMap | None: ...
    @property
    def start(self) -> float:
        """Time of the first state, s."""
        ...

    def ego_pose(self, time: float) -> FloatArray:
        """world_T_ego (4, 4) at `time`."""
        ...

    def visible_from(self, point: FloatArray, time: float, reach: float) -> tuple[Boxes, BoolArray, FloatArray]:
        """Objects as seen from a point, see `objects_seen_from`."""
        ...


def objects_seen_from(
    objects: SimulatedTrajectories, occluders: Boxes, point: FloatArray, time: float, reach: float
) -> tuple[Boxes, BoolArray, FloatArray]:
    """Objects as seen from a point (3,) at `time`, behind one another and behind `occluders`.

    Returns all N objects, a mask (N,) of those within `reach`, m, and the visible share of each of these.
    """
    boxes, present = objects.at(time)
    near = present & (np.linalg.norm(boxes.position[:, :2] - point[:2], axis=1) <= reach)
    around = Boxes.concatenate([boxes.select(near), occluders])
    return boxes, near, visible_share(point, around, np.arange(int(near.sum())))
