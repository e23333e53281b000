"""Providers of what is around the vehicle: landmarks, and objects seen from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factors import relative_factors
from saga_fg.errors import InputError
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import EGO_POSE, LANDMARK, OBJECT, NewVariable
from saga_fg.model.landmarks import PointLandmark
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.providers.odometry import NO_POSE
from saga_fg.settings import Positive, Settings, setting
from saga_fg.types.landmark import Observation


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
