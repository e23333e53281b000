"""Trucks that tow a trailer. They drive as one long vehicle, and are seen as two.

Both parts are on the path of the whole: the truck's middle (total - truck) / 2 before the middle of the whole, the
trailer's (total - trailer) / 2 behind it, along the lane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_tools.simulator.fleet import TRUCK, Fleet
from data_tools.simulator.lanes import Lanes
from data_tools.simulator.traffic import TrafficHistory
from data_tools.simulator.trajectories import Trajectories
from saga_fg.numerics.arrays import FloatArray, IntArray

HITCH = 0.9  # m between truck and trailer
TRAILER_LENGTH = (6.0, 11.0)  # m


def hitched(fleet: Fleet, share: float, rng: np.random.Generator) -> tuple[Fleet, FloatArray]:
    """A share of the trucks get a trailer: the fleet with their whole lengths, and the trailers' lengths (N,), m."""
    trailer = np.zeros(len(fleet))
    if share > 0:
        tows = (fleet.kind == TRUCK) & (rng.random(len(fleet)) < share)
        trailer = np.where(tows, rng.uniform(*TRAILER_LENGTH, len(fleet)), 0.0)
    size = fleet.size.copy()
    size[:, 0] += np.where(trailer > 0, trailer + HITCH, 0.0)
    return replace(fleet, size=size), trailer


def parted(
    vehicles: Trajectories, lanes: Lanes, history: TrafficHistory, trailer: FloatArray
) -> tuple[Trajectories, Trajectories]:
    """The vehicles, with the trucks' part alone of those that tow, and their trailers of lengths (N,) > 0."""
    rows = np.flatnonzero(trailer > 0)
    if len(rows) == 0:
        return vehicles, vehicles.select(rows)
    whole, behind = vehicles.size[rows, 0], trailer[rows]
    truck = whole - behind - HITCH
    position, yaw, velocity = (x.copy() for x in (vehicles.position, vehicles.yaw, vehicles.velocity))
    position[:, rows], yaw[:, rows], velocity[:, rows] = _moved(lanes, history, rows, (whole - truck) / 2)
    size = vehicles.size.copy()
    size[rows, 0] = truck
    place = _moved(lanes, history, rows, -(whole - behind) / 2)
    trailer_size = np.column_stack([behind, vehicles.size[rows, 1], vehicles.size[rows, 2]])
    trailers = Trajectories(
        np.char.replace(vehicles.id[rows], "vehicle", "trailer"),
        np.full(len(rows), "trailer"),
        trailer_size,
        vehicles.time,
        place[0],
        place[2],
        place[1],
        vehicles.present[:, rows],
    )
    return replace(vehicles, position=position, yaw=yaw, velocity=velocity, size=size), trailers


def _moved(
    lanes: Lanes, history: TrafficHistory, rows: IntArray, by: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position (T, k, 2), heading (T, k) and velocity (T, k, 2) of vehicles moved along their lanes by (k,) m."""
    lane, slope = history.lane[:, rows], history.slope[:, rows]
    position, heading = lanes.pose(lane, history.s[:, rows] + by, history.offset[:, rows] + slope * by, slope)
    heading = np.unwrap(heading, axis=0)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return position, heading, history.speed[:, rows, None] * direction
