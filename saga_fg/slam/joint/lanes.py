"""Attraction of moving vehicles to the centre line of the lane of a map that they drive along.

In a level frame at the foot of a vehicle on the line, x along the lane, y to its left, the vehicle is off the line by

    y - c ~ N(0, spread^2 m / P),      m = max(1, 2 memory / dt)

c is a landmark of its own, the offset of the lane to the left of its place in the map, c ~ N(0, deviation^2). A driver
stays off the centre for a while: with an offset that is correlated over `memory`, m epochs dt apart carry the
information of a single independent one. P is the probability of driving along the lane, known from the estimate so far:
of all lanes in its direction, with the offset e_j from each and its variance S = spread^2 + deviation^2 + n^T P_p n
(P_p: of the pose of the observing vehicle), the speed v across the lane, and P(stationary) as in
`saga_fg.slam.joint.association`,

    P(j) = q_j / (sum_i q_i + elsewhere / width),      q_j = N(e_j; 0, S)
    P    = (1 - P(stationary)) P(j) exp( -v^2 / (2 (drift^2 + sigma_v^2)) ),   sigma_v = speed * deviation of heading

Where the pose is known less well than a lane is wide, no lane is likely, and there is no factor; assigned anew along
the path found, round by round, the lanes take effect from where the pose is known better. A robust loss gives up
vehicles that change lanes. The factor is `factors.lane_keeping_factors`.

Online, a vehicle is assigned to its lane at its own epoch, and stays so while the epoch is in the window. A lane
without vehicles in the window leaves with the last of them; met again, it starts from the map alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Linearisable, Robust, lane_keeping_factors, prior_factor
from factors.manifolds import cross_matrix
from saga_fg.graph import MAP_NODE, Additions, GraphView, NewVariable, key_of
from saga_fg.model.edge_rules import VEHICLES
from saga_fg.model.interactions import POSITION
from saga_fg.model.motion import NodeType
from saga_fg.numerics.arrays import FloatArray, IntArray, of_classes
from saga_fg.numerics.geometry import feet, on_it, yaw_transform
from saga_fg.slam.joint.graph import JointEstimate, ObjectStates, Record, by_type, object_key
from saga_fg.types.road_map import RoadMap

_LIKELY = 0.9  # a vehicle that drives along a lane with less than this probability gets no factor
_LEAVING = 3.0  # times the spread: scale of the Cauchy loss on the offset from the centre line
OFFSET_DEVIATION = 0.3  # standard deviation of the offset from the centre line, m
OFFSET_TIME = 5.0  # correlation time of the offset of one driver, s
LATERAL_SPEED_SCALE = 0.8  # sigma of the kernel on the speed across the lane, m/s
OFF_LANE_SHARE = 0.1  # vehicles outside all lanes, as a share of those in one
LANE_PASSES = 3  # passes of assigning vehicles to lanes along the latest path
LANE_CLASSES = VEHICLES  # classes of objects that take part


def lane_key(number: int) -> int:
    """Key of the offset of a lane to the left of its place in the map."""
    return key_of(MAP_NODE, number, None)


@dataclass(frozen=True, eq=False)
class KnownLane:
    """A lane of a map: its number, centre line (k, 2), m, width, m, and the standard deviation of its place, m."""

    number: int
    centre: FloatArray
    width: float
    deviation: float


@dataclass(frozen=True, eq=False)
class LaneAssignment:
    """A vehicle that drives along a lane at an epoch: its id, the frame (4, 4) at its foot, and P as above."""

    epoch: int
    name: int
    lane: int
    world_T_foot: FloatArray
    probability: float


class LaneAssociation:
    """Provider of the lanes of the maps so far, and of the vehicles assigned to them."""

    name = "lanes"

    def __init__(self, used: bool, maps: Iterable[RoadMap | None]) -> None:
        self._used = used
        self._maps: list[RoadMap] = []
        self._lanes: list[KnownLane] = []
        self._record: Record = ()
        self._new: list[LaneAssignment] = []  # of the last call of `assign`, whose first epoch is `_first`
        self._all: list[LaneAssignment] = []
        self.add_maps(*maps)

    @property
    def rounds(self) -> int:
        """Number of assignments to make; 0 without lanes."""
        return LANE_PASSES if self._used and self._lanes else 0

    def add_maps(self, *maps: RoadMap | None) -> None:
        """Add maps of frames, most of which bring the same one."""
        for one in maps:
            if one is not None and all(one is not known for known in self._maps):
                self._maps.append(one)
                self._lanes = known_lanes(self._maps)

    def assign(self, record: Record, estimate: JointEstimate, stationary: Sequence[FloatArray]) -> bool:
        """Assign the vehicles of the last epochs of a record to lanes; returns whether any is assigned.

        estimate, stationary: of these epochs, and the probabilities (n,) that their objects are stationary
        """
        self._record, self._new, self._first = record, [], record[-len(estimate.objects)].epoch
        if self.rounds:
            for row in range(-len(estimate.objects), 0):
                now, pose = record[row], (estimate.world_T_ego[row], estimate.pose_covariances[row])
                self._new += assign_lanes(
                    now.epoch, estimate.objects[row], now.seen.id, stationary[row], pose, self._lanes
                )
        self._all += self._new
        return bool(self._new)

    def factors(self, view: GraphView) -> Additions:
        """Lanes that are new to the graph, and the vehicles last assigned."""
        if not self._used:
            return Additions()
        met = {one.lane for one in self._new}
        new = [one for one in self._lanes if one.number in met and lane_key(one.number) not in view.variables]
        lanes = [NewVariable(MAP_NODE, lane.number, np.zeros(1), static=True, label="lane") for lane in new]
        return Additions(lanes, lane_priors(new), {self._first: lane_factors(self._record, self._new)})

    def forget(self, first: int) -> list[int]:
        """Forget assignments before the epoch `first`; returns the keys of lanes that no vehicle is assigned to."""
        before = {one.lane for one in self._all}
        self._all = [one for one in self._all if one.epoch >= first]
        return [lane_key(number) for number in before - {one.lane for one in self._all}]


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


def assign_lanes(
    epoch: int,
    objects: ObjectStates,
    seen: IntArray,
    stationary: FloatArray,
    pose: tuple[FloatArray, FloatArray],
    lanes: Sequence[KnownLane],
) -> list[LaneAssignment]:
    """Assign the objects of an epoch to lanes.

    seen (m,) ids of detected ones; stationary (n,) probabilities of the objects; pose: (4, 4), and its covariance
    (6, 6) in its own frame.
    """
    rows = np.flatnonzero(np.isin(objects.id, seen) & of_classes(np.array(objects.label), LANE_CLASSES))
    if not len(rows) or not lanes:
        return []
    place, velocity = objects.position[rows], objects.velocity[rows]
    world_T_ego, P = pose
    at = [feet(lane.centre, place) for lane in lanes]
    t = np.stack([one.direction for one in at])
    n = np.stack([-t[..., 1], t[..., 0]], axis=-1)
    along, across = np.einsum("jmi,mi->jm", t, velocity), np.einsum("jmi,mi->jm", n, velocity)
    deviation = np.array([lane.deviation for lane in lanes])[:, None]
    S = OFFSET_DEVIATION**2 + deviation**2 + np.einsum("jmi,mik,jmk->jm", n, _shift(place, world_T_ego, P), n)
    off = np.stack([one.e for one in at])
    there = np.stack([on_it(lane.centre, one.s) for lane, one in zip(lanes, at, strict=True)]) & (along > 0)
    q = np.where(there, np.exp(-(off**2) / (2 * S)) / np.sqrt(2 * math.pi * S), 0.0)
    beside = OFF_LANE_SHARE / np.array([lane.width for lane in lanes])[:, None]
    likely = q / (q.sum(axis=0) + beside)
    drift = LATERAL_SPEED_SCALE**2 + along**2 * P[2, 2]
    p = likely * (1 - stationary[rows]) * np.exp(-(across**2) / (2 * drift))
    found = []
    for column, j in enumerate(np.argmax(likely, axis=0).tolist()):
        if likely[j, column] >= _LIKELY:
            x, y = at[j].point[column].tolist()
            foot = yaw_transform(x, y, yaw=math.atan2(t[j, column, 1], t[j, column, 0]))
            name = int(objects.id[rows[column]])
            found.append(LaneAssignment(epoch, name, lanes[j].number, foot, float(p[j, column])))
    return found


def lane_factors(record: Record, kept: Sequence[LaneAssignment]) -> list[Linearisable]:
    """The factors of assigned vehicles."""
    times = {now.epoch: now.time for now in record}
    types: dict[tuple[int, int], NodeType] = {
        (now.epoch, int(name)): node_type
        for now in record
        for name, node_type in zip(now.objects.id, now.objects.types, strict=True)
    }
    step = np.median(np.diff(sorted(times.values()))) if len(times) > 1 else OFFSET_TIME
    variance = OFFSET_DEVIATION**2 * max(1.0, 2 * OFFSET_TIME / float(step))
    present = [one for one in kept if (one.epoch, one.name) in types and one.probability > 1e-6]
    factors: list[Linearisable] = []
    for node_type, mine in by_type([types[one.epoch, one.name] for one in present]):
        some = [present[row] for row in mine.tolist()]
        x, y = node_type.index(POSITION).tolist()
        factors.append(
            lane_keeping_factors(
                np.array([[object_key(one.epoch, one.name), lane_key(one.lane)] for one in some], dtype=np.uint64),
                variance / np.array([one.probability for one in some]),
                np.stack([one.world_T_foot for one in some]),
                1,
                node_type.dim,
                (x, y),
                robust=Robust("cauchy", _LEAVING * OFFSET_DEVIATION / math.sqrt(variance)),
            )
        )
    return factors


def lane_priors(lanes: Iterable[KnownLane]) -> list[gtsam.JacobianFactor]:
    """Priors of the offsets of lanes."""
    return [prior_factor(lane_key(lane.number), np.zeros(1), np.array([[lane.deviation**2]])) for lane in lanes]


def _shift(place: FloatArray, world_T_ego: FloatArray, P: FloatArray) -> FloatArray:
    """Covariances (m, 2, 2) of places (m, 2) that move with the pose, at the pose's height: R (v - [z]x w)."""
    R = world_T_ego[:3, :3]
    offset = np.column_stack([place - world_T_ego[:2, 3], np.zeros(len(place))])
    J = np.concatenate([-R @ cross_matrix(offset @ R), np.broadcast_to(R, (len(place), 3, 3))], axis=2)[:, :2]
    return np.asarray(J @ P @ J.swapaxes(1, 2))
