"""Landmarks with known identities, seen from the vehicle; each is a variable for all time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from saga_fg.errors import InputError
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.keys import EGO_POSE, LANDMARK
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.graph.variables import NewVariable
from saga_fg.model.landmarks.point import PointLandmark
from saga_fg.providers.start import NO_POSE
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
            given = kind.factors(rows, seen.value[None], seen.covariance[None])
            factors += [given] if isinstance(given, gtsam.NonlinearFactorGraph) else given
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
