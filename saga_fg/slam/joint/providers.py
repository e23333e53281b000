"""Factor providers of the vehicle and the objects around it, of a whole recording or of a moment that comes."""

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
    Keyed,
    detections,
    error_key,
    linear_factors,
    object_key,
    odometry,
    standing_factors,
    start_factors,
)
from saga_fg.slam.joint.settings import JointSettings

_SAME = 1e-3  # probability


@dataclass(frozen=True, eq=False)
class Moments:
    """The moments of `record`, one a frame; the graph has the first `known` of them already.

    path: poses (4, 4) where the vehicle is expected at the others. Odometry and detections come with the last moment,
    so that all are linearised together.
    """

    record: Keyed
    path: Sequence[FloatArray] | FloatArray
    settings: JointSettings
    known: int = 0
    name: str = "vehicle and objects"

    def factors(self, view: GraphView) -> Additions:
        row = view.epoch - self.record[0][0]
        (k, moment), pose = self.record[row], self.path[row - self.known]
        before = set(self.record[row - 1][1].objects.id.tolist()) if row else set()
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        seen = dict(zip(moment.seen.id.tolist(), transform_points(pose, moment.seen.z)[:, :2], strict=True))
        objects = moment.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label, strict=True):
            state = np.zeros(kind.dim)
            if name in before:  # it goes on as it was going
                state = np.array(view.state(object_key(k - 1, name)))
                state[kind.index(POSITION)] += view.dt * state[kind.index(VELOCITY)]
            if name in seen:
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*linear_factors(k, moment, before)]
        if k == 0:
            factors += start_factors(k, pose, self.settings)
        if row + 1 == len(self.record):
            factors += odometry(self.record[max(self.known - 1, 0) :], self.settings)
            factors += detections(self.record[self.known :], self.settings)
        return Additions(new, factors)


class Standing:
    """Who probably stands, for every two moments of the window, given anew where the probabilities have changed."""

    name = "standing objects"

    def __init__(self, settings: JointSettings) -> None:
        self._settings = settings
        self._given: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._record: Keyed = []
        self._now: Sequence[FloatArray] = ()

    def with_probabilities(self, record: Keyed, standing: Sequence[FloatArray]) -> Standing:
        """With the probabilities of all moments of the window."""
        self._record, self._now = list(record), standing
        return self

    def factors(self, view: GraphView) -> Additions:
        named: dict[Hashable, Factors] = {}
        given: dict[int, tuple[FloatArray, FloatArray]] = {}
        for pair, ((j, _), (k, _)) in zip(pairwise(self._now), pairwise(self._record), strict=True):
            before = self._given.get(k) if j in self._given or k in self._given else None
            if before is not None and all(np.allclose(a, b, atol=_SAME) for a, b in zip(before, pair, strict=True)):
                given[k] = before
                continue
            given[k] = pair
            rows = self._record[k - self._record[0][0] - 1 : k - self._record[0][0] + 1]
            named[k] = standing_factors(rows, pair, self._settings)
        self._given = given
        return Additions(named=named)
