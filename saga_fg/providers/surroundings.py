"""Providers of what is around the vehicle: landmarks, lanes, and objects seen from it.

Attraction to lanes: vehicles that go along a lane keep to its centre line,

    r = n . (p - f) - c,    r ~ N(0, deviation^2 / dt).

f is the foot of an object's place p on the line, n the normal there, c how far the line lies aside of where the map has
it, a variable for all time with a prior. The loss is robust: it lets go of objects that change lanes. The variance
shrinks with the length of the interval, so that a second has the same weight at any rate of frames.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factors import ResidualFactors, Robust, prior_factor, relative_factors
from saga_fg.errors import InputError
from saga_fg.graph import EGO_POSE, LANDMARK, MAP_NODE, OBJECT, Additions, Factor, GraphView, NewVariable
from saga_fg.model import PointLandmark
from saga_fg.numerics import FloatArray, IntArray, feet, on_it
from saga_fg.providers.odometry import NO_POSE
from saga_fg.settings import Positive, Settings, setting, settings_group
from saga_fg.types import VEHICLES, Lane, Observation

ALONG = 0.9  # cosine of the angle between a course and a lane within which an object goes along it
MIN_SPEED = 1.0  # m/s; slower vehicles keep to no lane
LANE_LOSS = Robust("cauchy", 3.0)  # standard deviations


@dataclass(frozen=True)
class Landmarks(Settings):
    """Add observations of landmarks (`frame.ego.landmarks`), and each landmark when it is first seen.

    Which one is seen is known; its kind is the observation's (`saga_fg.slam.mapping`).
    """

    labels: tuple[str, ...] = setting(
        (), "labels of detections in the vehicle's frame that are observations of one point each"
    )
    deviation: Positive = setting(0.3, "standard deviation of such an observation, m")
    name = "landmarks"

    def factors(self, view: GraphView) -> Additions:
        pose = view.now(EGO_POSE).get(0)
        if view.frame is None:
            return Additions()
        if pose is None:
            raise InputError(NO_POSE)
        known, world_T_pose = view.static(LANDMARK), view.state(pose.key).matrix()
        new: dict[int, NewVariable] = {}
        factors: list[Factor] = []
        for name, seen in self._observations(view, planar=pose.dim == 3):
            kind = seen.kind
            if name not in known and name not in new:
                start = kind.initialise(world_T_pose, seen.value)
                new[name] = NewVariable(LANDMARK, name, start, static=True, label=kind.name, type=kind.variable)
            rows = np.array([[pose.key, view.key(LANDMARK, name, static=True)]], dtype=np.int64)
            factors += kind.factors(rows, seen.value[None], seen.covariance[None])
        return Additions(list(new.values()), factors)

    def _observations(self, view: GraphView, planar: bool) -> Iterator[tuple[int, Observation]]:
        frame = view.frame
        assert frame is not None
        if frame.ego is not None:
            yield from frame.ego.landmarks.items()
        if not self.labels or frame.coordinates != "ego":
            return
        dim = 2 if planar else 3
        for label, place in zip(frame.detections.boxes.label, frame.detections.boxes.position, strict=True):
            if label in self.labels:
                yield (
                    self.labels.index(label),
                    Observation(PointLandmark(dim, name=str(label)), place[:dim], self.deviation**2 * np.eye(dim)),
                )


@dataclass(frozen=True, eq=False)
class RelativeDetections:
    """Measurements of objects with known ids at this epoch.

    nodes (k,) ids; z (k, 3) in the vehicle's frame, m; R (k, 2, 2) in its axes, m^2; dim of the objects' states;
    position: where in them the place is
    """

    nodes: IntArray
    z: FloatArray
    R: FloatArray
    dim: int = 4
    position: tuple[int, int] = (0, 1)
    name: str = "detections"

    def factors(self, view: GraphView) -> Additions:
        if len(self.nodes) == 0:
            return Additions()
        pose = view.now(EGO_POSE).get(0)
        if pose is None:
            raise InputError(NO_POSE)
        rows = np.array([[pose.key, view.key(OBJECT, node)] for node in self.nodes.tolist()], dtype=np.uint64)
        z = self.z[:, : 2 if pose.dim == 3 else 3]
        return Additions(factors=[relative_factors(rows, z, self.R, self.dim, self.position)])


@dataclass(frozen=True)
class LaneKeeping(Settings):
    """Attracts vehicles that drive along a lane to its centre line; how far the map is off is estimated."""

    lanes: tuple[Lane, ...] = settings_group(tuple, "lanes in world coordinates")
    deviation: Positive = setting(
        0.5, "standard deviation of the offset left after one second in the lane, m; lower: stronger"
    )
    map_deviation: Positive = setting(
        0.3, "standard deviation of the lanes in the map, m; higher: vehicles say where they are"
    )
    classes: tuple[str, ...] = setting(VEHICLES, "classes that keep to lanes")
    name = "lanes"

    def factors(self, view: GraphView) -> Additions:
        if not self.lanes:
            raise InputError("lanes: expected one at least")
        objects = [one for one in view.now(OBJECT).values() if one.label in self.classes and one.dim >= 4]
        if not objects or view.dt == 0:
            return Additions()
        states = np.array([view.state(one.key)[:4] for one in objects])  # (x, y, vx, vy, ...)
        known, new, factors = view.static(MAP_NODE), list[NewVariable](), list[Factor]()
        for number, lane in enumerate(self.lanes):
            centre = np.array(lane.centre) - view.origin
            rows = _going_along(centre, lane.width, states)
            if len(rows) == 0:
                continue
            key = view.key(MAP_NODE, number, static=True)
            if number not in known:
                new.append(NewVariable(MAP_NODE, number, np.zeros(1), static=True, label=f"lane {lane.name}"))
                factors.append(prior_factor(key, np.zeros(1), [[self.map_deviation**2]]))
            for dim in {objects[row].dim for row in rows.tolist()}:
                mine = np.array([row for row in rows.tolist() if objects[row].dim == dim])
                at = feet(centre, states[mine, :2])
                normal = np.stack([-at.direction[:, 1], at.direction[:, 0]], axis=1)
                keys = np.array([[objects[row].key, key] for row in mine.tolist()], dtype=np.uint64)
                aside, R = _Aside(at.point, normal, dim), self.deviation**2 / view.dt * np.eye(1)
                kind = "vehicles in a lane"
                factors.append(
                    ResidualFactors(keys, (dim, 1), aside.residual, R, aside.jacobians, LANE_LOSS, name=kind)
                )
        return Additions(new, factors)


def _going_along(centre: FloatArray, width: float, states: FloatArray) -> IntArray:
    """Rows (k,) of the states (n, 4) that go along a lane."""
    at, speed = feet(centre, states[:, :2]), np.hypot(*states[:, 2:].T)
    along = np.einsum("ni,ni->n", at.direction, states[:, 2:])
    inside = on_it(centre, at.s) & (np.abs(at.e) < width / 2)
    return np.flatnonzero(inside & (speed >= MIN_SPEED) & (along >= ALONG * speed))


@dataclass(frozen=True, eq=False)
class _Aside:
    """How far n places lie aside of a line with an offset: its points and normals (n, 2) at their feet."""

    foot: FloatArray
    normal: FloatArray
    dim: int

    def residual(self, state: FloatArray, offset: FloatArray) -> FloatArray:
        aside: FloatArray = (self.normal * (state[:, :2] - self.foot)).sum(axis=1, keepdims=True)
        return aside - offset

    def jacobians(self, state: FloatArray, offset: FloatArray) -> list[FloatArray]:
        by_state = np.zeros((len(state), 1, self.dim))
        by_state[:, 0, :2] = self.normal
        return [by_state, np.full((len(offset), 1, 1), -1.0)]
