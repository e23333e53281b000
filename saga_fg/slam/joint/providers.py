"""Factor providers of the vehicle and the objects around it, for a whole recording or epoch by epoch."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from factors import ERROR_DIM
from saga_fg.graph import EGO_ERROR, EGO_POSE, OBJECT, Additions, GraphView, NewVariable
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.providers import Factors
from saga_fg.model.interactions import POSITION, VELOCITY
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import transform_points
from saga_fg.slam.joint.graph import (
    Record,
    detections,
    error_key,
    new_object_factors,
    object_key,
    odometry,
    start_factors,
    stationary_factors,
)
from saga_fg.slam.joint.motion import motion_factors, new_streams
from saga_fg.slam.joint.record import RecordedEpoch
from saga_fg.slam.joint.settings import JointSettings

_SAME = 1e-3  # probability
_VEHICLE_AND_OBJECTS = "vehicle and objects"


@dataclass(frozen=True, eq=False)
class VehicleAndObjects:
    """Add the epochs of `record`, one a frame, of which the graph has the first `known` already.

    path: expected poses (4, 4) of the others. Odometry and detections come with the last epoch, so that all are
    linearised together.
    """

    record: Record
    path: Sequence[FloatArray] | FloatArray
    settings: JointSettings
    known: int = 0
    name: str = _VEHICLE_AND_OBJECTS

    def factors(self, view: GraphView) -> Additions:
        row = view.epoch - self.record[0].epoch
        now, pose, k = self.record[row], self.path[row - self.known], view.epoch
        before = set(self.record[row - 1].objects.id.tolist()) if row else set()
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        seen = dict(zip(now.seen.id.tolist(), transform_points(pose, now.seen.z)[:, :2], strict=True))
        objects = now.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label, strict=True):
            state = np.zeros(kind.dim)
            if name in before:  # at constant velocity
                state = np.array(view.state(object_key(k - 1, name)))
                state[kind.index(POSITION)] += view.dt * state[kind.index(VELOCITY)]
            if name in seen:
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*new_object_factors(now, before)]
        named: dict[Hashable, Factors] = {}
        if before:
            new += new_streams(now)
            factors += motion_factors(now)
        if k == 0:
            factors += start_factors(k, pose, self.settings)
        if row + 1 == len(self.record):
            factors += odometry(self.record[max(self.known - 1, 0) :], self.settings)
            named[detections_name(now)] = detections(self.record[self.known :], self.settings)
        return Additions(new, factors, named=named)


def detections_name(now: RecordedEpoch) -> Hashable:
    """Name of the detections up to an epoch among the factors of `VehicleAndObjects`."""
    return ("detections", now.epoch)


@dataclass(frozen=True, eq=False)
class Detections:
    """Replace the detections of an epoch that `VehicleAndObjects` has added alone."""

    now: RecordedEpoch
    settings: JointSettings
    name: str = _VEHICLE_AND_OBJECTS

    def factors(self, view: GraphView) -> Additions:
        return Additions(named={detections_name(self.now): detections([self.now], self.settings)})


class StationaryPairs:
    """Add factors of stationary objects for every two epochs, replaced where the probabilities have changed."""

    name = "stationary objects"

    def __init__(self) -> None:
        self._given: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._record: Record = ()
        self._now: Sequence[FloatArray] = ()

    def with_probabilities(self, record: Record, stationary: Sequence[FloatArray]) -> StationaryPairs:
        """With the probabilities (n,) of the objects of each epoch of the window."""
        self._record, self._now = list(record), stationary
        return self

    def factors(self, view: GraphView) -> Additions:
        named: dict[Hashable, Factors] = {}
        given: dict[int, tuple[FloatArray, FloatArray]] = {}
        for pair, rows in zip(pairwise(self._now), pairwise(self._record), strict=True):
            k = rows[1].epoch
            before = self._given.get(k)
            if before is not None and all(np.allclose(a, b, atol=_SAME) for a, b in zip(before, pair, strict=True)):
                given[k] = before
                continue
            given[k] = pair
            named[k] = stationary_factors(rows, pair)
        self._given = given
        return Additions(named=named)
