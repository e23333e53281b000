"""Trucks that tow a trailer: one long vehicle in traffic, two objects in the scene.

Both parts follow the path of the combination: along the lane, the truck's centre is (total - truck) / 2 ahead of the
centre of the combination, the trailer's is (total - trailer) / 2 behind it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_tools.simulator.fleet import HITCH
from data_tools.simulator.lanes import Lanes
from data_tools.simulator.traffic import TrafficHistory
from data_tools.simulator.trajectories import SimulatedTrajectories
from saga_fg.numerics.arrays import FloatArray, IntArray


def split_trailers(
    vehicles: SimulatedTrajectories, lanes: Lanes, history: TrafficHistory, trailer: FloatArray
) -> tuple[SimulatedTrajectories, SimulatedTrajectories]:
    """The vehicles without their trailers, and the trailers; `trailer` (N,) are their lengths, m, 0 for none."""
    rows = np.flatnonzero(trailer > 0)
    if len(rows) == 0:
        return vehicles, vehicles.select(rows)
    whole, behind = vehicles.size[rows, 0], trailer[rows]
    truck = whole - behind - HITCH
    position, yaw, velocity = (x.copy() for x in (vehicles.position, vehicles.yaw, vehicles.velocity))
    position[:, rows], yaw[:, rows], velocity[:, rows] = _shifted(lanes, history, rows, (whole - truck) / 2)
    size = vehicles.size.copy()
    size[rows, 0] = truck
    pose = _shifted(lanes, history, rows, -(whole - behind) / 2)
    trailer_size = np.column_stack([behind, vehicles.size[rows, 1], vehicles.size[rows, 2]])
    trailers = SimulatedTrajectories(
        np.char.replace(vehicles.id[rows], "vehicle", "trailer"),
        np.full(len(rows), "trailer"),
        trailer_size,
        vehicles.time,
        pose[0],
        pose[2],
        pose[1],
        vehicles.present[:, rows],
    )
    return replace(vehicles, position=position, yaw=yaw, velocity=velocity, size=size), trailers


def _shifted(
    lanes: Lanes, history: TrafficHistory, rows: IntArray, by: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position (T, k, 2), heading (T, k) and velocity (T, k, 2) of points `by` (k,) m ahead of vehicles' centres."""
    lane, slope = history.lane[:, rows], history.slope[:, rows]
    position, heading = lanes.pose(lane, history.s[:, rows] + by, history.offset[:, rows] + slope * by, slope)
    heading = np.unwrap(heading, axis=0)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return position, heading, history.speed[:, rows, None] * direction
