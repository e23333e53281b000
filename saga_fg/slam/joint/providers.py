"""Factor providers of the joint estimation, for a whole recording or a window of epochs."""

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
    motion_factors,
    new_object_factors,
    new_streams,
    object_key,
    odometry,
    start_factors,
    stationary_factors,
)
from saga_fg.slam.joint.record import JointSettings, RecordedEpoch
from saga_fg.slam.mapping import Given

_SAME = 1e-3  # probability


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
    name: str = "vehicle and objects"

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


class StationaryPairs:
    """Factors of stationary objects for every two epochs, given anew where the probabilities have changed."""

    name = "stationary objects"

    def __init__(self) -> None:
        self._given: dict[int, tuple[FloatArray, FloatArray]] = {}

    def changed(self, record: Record, stationary: Sequence[FloatArray]) -> Given:
        """Return the provider of a window, with the probabilities (n,) of the objects of each epoch."""
        named: dict[Hashable, Factors] = {}
        given: dict[int, tuple[FloatArray, FloatArray]] = {}
        for pair, rows in zip(pairwise(stationary), pairwise(record), strict=True):
            k, before = rows[1].epoch, self._given.get(rows[1].epoch)
            if before is None or not all(np.allclose(a, b, atol=_SAME) for a, b in zip(before, pair, strict=True)):
                named[k], before = stationary_factors(rows, pair), pair
            given[k] = before
        self._given = given
        return Given(Additions(named=named), self.name)
