"""Landmarks along a path assumed so far: which observation is of which, where nobody knows.

It is of the nearest landmark of its kind, by where that was last seen, within `reach`; else of a new one. A pose drifts
little between two views of one thing, and the question is asked anew along the path found.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LandmarkObservations
from saga_fg.types.landmark import LandmarkType, Observation

Observations = Sequence[Sequence[Observation]]


def nearest_landmarks(observations: Observations, path: FloatArray, reach: float) -> LandmarkObservations:
    """Tell apart what is observed at n moments along a path (n, 4, 4); reach in m."""
    start: dict[int, Any] = {}
    places: dict[LandmarkType, dict[int, FloatArray]] = {}
    seen: dict[int, list[tuple[int, Observation]]] = {}
    for moment, (now, pose) in enumerate(zip(observations, path, strict=True)):
        for observation in now:
            state = observation.kind.initialise(pose, observation.value)
            where = observation.kind.coordinates(state)
            place = np.array([where["x"], where["y"]])
            known = places.setdefault(observation.kind, {})
            distance = {number: float(np.linalg.norm(there - place)) for number, there in known.items()}
            number = min(distance, key=distance.__getitem__, default=len(start))
            if distance.get(number, np.inf) > reach:
                number = len(start)
                start[number] = state
            known[number] = place
            seen.setdefault(moment, []).append((number, observation))
    return LandmarkObservations(seen, start)
