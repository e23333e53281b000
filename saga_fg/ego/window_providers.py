"""Factor providers of the online window: a moment with its odometry, objects and detections, and who stands."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from factors import ERROR_DIM
from saga_fg.arrays import FloatArray
from saga_fg.ego.graph import (
    Keyed,
    detections,
    error_key,
    linear_factors,
    object_key,
    odometry,
    standing_factors,
    start_factors,
)
from saga_fg.ego.settings import JointSettings
from saga_fg.geometry import transform_points
from saga_fg.graph import EGO_ERROR, EGO_POSE, OBJECT, Additions, GraphView, NewVariable
from saga_fg.graph.factor_checks import Factor
from saga_fg.graph.providers import Factors
from saga_fg.interactions import POSITION, VELOCITY

_SAME = 1e-3  # probability


@dataclass(frozen=True, eq=False)
class NewMoment:
    """The last of `record`, after the one before: pose (4, 4) where the vehicle is expected."""

    record: Keyed
    pose: FloatArray
    settings: JointSettings
    name: str = "vehicle and objects"

    def factors(self, view: GraphView) -> Additions:
        (k, moment), before = self.record[-1], view.before(OBJECT)
        last = self.record[-2:]
        slow = view.state(error_key(k - 1)) if k else np.zeros(ERROR_DIM)
        new = [NewVariable(EGO_POSE, 0, gtsam.Pose3(self.pose), label="vehicle"), NewVariable(EGO_ERROR, 0, slow)]
        seen = dict(zip(moment.seen.id.tolist(), transform_points(self.pose, moment.seen.z)[:, :2], strict=True))
        objects = moment.objects
        for name, kind, label in zip(objects.id.tolist(), objects.types, objects.label, strict=True):
            if name in before:  # it goes on as it was going
                state = np.array(view.state(object_key(k - 1, name)))
                state[kind.index(POSITION)] += view.dt * state[kind.index(VELOCITY)]
            else:
                state = np.zeros(kind.dim)
                state[kind.index(POSITION)] = seen[name]
            new.append(NewVariable(OBJECT, name, state, label=label))
        factors: list[Factor] = [*linear_factors(k, moment, set(before))]
        factors += [*odometry(last, self.settings), *detections(last[-1:], self.settings)]
        if k == 0:
            factors += start_factors(k, self.pose, self.settings)
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
