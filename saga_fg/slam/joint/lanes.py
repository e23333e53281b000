"""Moving vehicles are drawn to the centre line of the lane of a map that they drive along.

In a level frame at the foot of a vehicle on the line, x along the lane, y to its left, the vehicle is off the line by

    y - c ~ N(0, spread^2 m / P),      m = max(1, 2 memory / dt)

c is a landmark of its own, how far to its left the lane lies of where the map has it, c ~ N(0, deviation^2). Drivers
who keep off the centre do so for a while: with an offset that is correlated over `memory`, moments dt apart say as
much as one in m of independent ones would. P is the probability of driving along the lane, known from the estimate so
far: of all lanes that run its way, beside which it is e_j off with the variance S = spread^2 + deviation^2 + n^T P_p n
(P_p what the pose of the vehicle that sees it adds), with v sideways, and P(stands) as in
`saga_fg.slam.joint.standing`,

    P(j) = q_j / (sum_i q_i + elsewhere / width),      q_j = N(e_j; 0, S)
    P    = (1 - P(stands)) P(j) exp( -v^2 / (2 (drift^2 + sigma_v^2)) ),      sigma_v = speed times heading's deviation

Where the pose is less well known than to a lane's width no lane is likely, and nothing is said: the lanes then take
hold from where it is known better, round by round. A robust loss lets go who changes lanes. The factor is
`factors.lane_keeping_factors`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Linearisable, Robust, lane_keeping_factors, prior_factor
from factors.rotations import cross_matrix
from saga_fg.graph import MAP_NODE, key_of
from saga_fg.model.interactions import POSITION
from saga_fg.model.node import NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.numerics.polyline import feet, on_it
from saga_fg.slam.joint.estimate import ObjectStates
from saga_fg.slam.joint.graph import Keyed, by_type, object_key
from saga_fg.slam.joint.settings import LaneSettings
from saga_fg.types.road_map import RoadMap

_LIKELY = 0.9  # a vehicle that drives along a lane with less than this probability is not drawn to it
_LEAVING = 3.0  # times the spread: farther from the centre line a vehicle is drawn less and less (Cauchy)


def lane_key(number: int) -> int:
    """Key of how far a lane lies to the left of where the map has it."""
    return key_of(MAP_NODE, number, None)


@dataclass(frozen=True, eq=False)
class KnownLane:
    """A lane of a map: its number, centre line (k, 2), m, width, m, and the standard deviation of its place, m."""

    number: int
    centre: FloatArray
    width: float
    deviation: float


@dataclass(frozen=True, eq=False)
class Keeping:
    """A vehicle that drives along a lane at a moment: its id, the frame (4, 4) at its foot, and P as above."""

    moment: int
    name: int
    lane: int
    world_T_foot: FloatArray
    probability: float


def known_lanes(maps: Iterable[RoadMap | None]) -> list[KnownLane]:
    """The lanes of maps, each name once."""
    lanes: dict[str, KnownLane] = {}
    for road_map in maps:
        if road_map is None:
            continue
        for lane in road_map.lanes:
            if lane.name not in lanes:
                lanes[lane.name] = KnownLane(len(lanes), np.array(lane.centre), lane.width, road_map.deviation)
    return list(lanes.values())


def keepings(
    moment: int,
    objects: ObjectStates,
    seen: IntArray,
    standing: FloatArray,
    pose: tuple[FloatArray, FloatArray],
    lanes: Sequence[KnownLane],
    settings: LaneSettings,
) -> list[Keeping]:
    """Which objects of a moment keep which lane.

    seen (m,) ids; standing (n,) the probabilities that the objects stand; pose: (4, 4), and its covariance (6, 6) in
    its own frame.
    """
    rows = np.flatnonzero(np.isin(objects.id, seen) & of_classes(np.array(objects.label), settings.classes))
    if not len(rows) or not lanes:
        return []
    place, velocity = objects.position[rows], objects.velocity[rows]
    world_T_ego, P = pose
    at = [feet(lane.centre, place) for lane in lanes]
    t = np.stack([one.direction for one in at])
    n = np.stack([-t[..., 1], t[..., 0]], axis=-1)
    along, across = np.einsum("jmi,mi->jm", t, velocity), np.einsum("jmi,mi->jm", n, velocity)
    deviation = np.array([lane.deviation for lane in lanes])[:, None]
    S = settings.spread**2 + deviation**2 + np.einsum("jmi,mik,jmk->jm", n, _shift(place, world_T_ego, P), n)
    off = np.stack([one.e for one in at])
    there = np.stack([on_it(lane.centre, one.s) for lane, one in zip(lanes, at, strict=True)]) & (along > 0)
    q = np.where(there, np.exp(-(off**2) / (2 * S)) / np.sqrt(2 * math.pi * S), 0.0)
    beside = settings.elsewhere / np.array([lane.width for lane in lanes])[:, None]
    likely = q / (q.sum(axis=0) + beside)
    drift = settings.drift**2 + along**2 * P[2, 2]
    p = likely * (1 - standing[rows]) * np.exp(-(across**2) / (2 * drift))
    found = []
    for column, j in enumerate(np.argmax(likely, axis=0).tolist()):
        if likely[j, column] >= _LIKELY:
            x, y = at[j].point[column].tolist()
            foot = yaw_transform(x, y, yaw=math.atan2(t[j, column, 1], t[j, column, 0]))
            name = int(objects.id[rows[column]])
            found.append(Keeping(moment, name, lanes[j].number, foot, float(p[j, column])))
    return found


def lane_factors(record: Keyed, kept: Sequence[Keeping], settings: LaneSettings) -> list[Linearisable]:
    """The factors of vehicles that keep a lane."""
    times = {k: moment.time for k, moment in record}
    types: dict[tuple[int, int], NodeType] = {
        (k, int(name)): node_type
        for k, moment in record
        for name, node_type in zip(moment.objects.id, moment.objects.types, strict=True)
    }
    step = np.median(np.diff(sorted(times.values()))) if len(times) > 1 else settings.memory
    variance = settings.spread**2 * max(1.0, 2 * settings.memory / float(step))
    present = [one for one in kept if (one.moment, one.name) in types and one.probability > 1e-6]
    factors: list[Linearisable] = []
    for node_type, mine in by_type([types[one.moment, one.name] for one in present]):
        some = [present[row] for row in mine.tolist()]
        x, y = node_type.index(POSITION).tolist()
        factors.append(
            lane_keeping_factors(
                np.array([[object_key(one.moment, one.name), lane_key(one.lane)] for one in some], dtype=np.uint64),
                variance / np.array([one.probability for one in some]),
                np.stack([one.world_T_foot for one in some]),
                1,
                node_type.dim,
                (x, y),
                robust=Robust("cauchy", _LEAVING * settings.spread / math.sqrt(variance)),
            )
        )
    return factors


def lane_priors(lanes: Iterable[KnownLane]) -> list[gtsam.JacobianFactor]:
    """The knowledge of a map of where its lanes are."""
    return [prior_factor(lane_key(lane.number), np.zeros(1), np.array([[lane.deviation**2]])) for lane in lanes]


def _shift(place: FloatArray, world_T_ego: FloatArray, P: FloatArray) -> FloatArray:
    """(m, 2, 2) of how places (m, 2) move with the pose, at the pose's height: R (v - [z]x w)."""
    R = world_T_ego[:3, :3]
    offset = np.column_stack([place - world_T_ego[:2, 3], np.zeros(len(place))])
    J = np.concatenate([-R @ cross_matrix(offset @ R), np.broadcast_to(R, (len(place), 3, 3))], axis=2)[:, :2]
    return np.asarray(J @ P @ J.swapaxes(1, 2))
