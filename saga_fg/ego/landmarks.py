"""Landmarks in the joint graph: poles, planes, points of `saga_fg.landmarks`, seen from the vehicle's poses.

Whoever knows which observation is of which landmark gives a `LandmarkPart`. Else that is decided along the path assumed
so far: the nearest landmark of the kind, by where it was last seen, within `reach`; else a new one. A pose drifts
little between two views of one thing, and the question is asked anew along the path found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import Linearisable
from saga_fg.arrays import FloatArray
from saga_fg.ego.graph import pose_key
from saga_fg.graph import LANDMARK, key_of
from saga_fg.landmarks import LandmarkType, Observation, sighting_factors

Observations = Sequence[Sequence[Observation]]


@dataclass(frozen=True, eq=False)
class LandmarkPart:
    """What landmarks add to the graph: native factors, our own, and where each landmark is to begin with, by key.

    Keys are those of `pose_key` and `landmark_key`. Other factors between poses, such as loop closures, may be among
    them.
    """

    graph: gtsam.NonlinearFactorGraph
    factors: list[Linearisable]
    start: gtsam.Values


def landmark_key(number: int) -> int:
    """Key of a landmark."""
    return key_of(LANDMARK, number, None)


def landmark_part(observations: Observations, path: FloatArray, reach: float) -> LandmarkPart:
    """Factors of observations of each moment (n) along a path (n, 4, 4); reach in m."""
    start = gtsam.Values()
    places: dict[LandmarkType, list[FloatArray]] = {}
    keys: dict[LandmarkType, list[int]] = {}
    seen: list[tuple[int, int, Observation]] = []
    for moment, (now, pose) in enumerate(zip(observations, path, strict=True)):
        for observation in now:
            kind = observation.kind
            state = kind.initialise(pose, observation.value)
            where = kind.coordinates(state)
            place = np.array([where["x"], where["y"]])
            known = places.setdefault(kind, [])
            distance = np.linalg.norm(np.reshape(known, (-1, 2)) - place, axis=1)
            if len(known) == 0 or distance.min() > reach:
                number = len(known)
                keys.setdefault(kind, []).append(landmark_key(start.size()))
                known.append(place)
                start.insert(keys[kind][number], state)
            else:
                number = int(np.argmin(distance))
                known[number] = place
            seen.append((pose_key(moment), keys[kind][number], observation))
    return LandmarkPart(*sighting_factors(seen), start)
