"""Factors of what was observed of landmarks, from which pose."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from factors import Linearisable
from saga_fg.landmarks.protocol import LandmarkType, Observation


def sighting_factors(
    sightings: Iterable[tuple[int, int, Observation]],
) -> tuple[gtsam.NonlinearFactorGraph, list[Linearisable]]:
    """The factors of sightings, each (key of the pose, key of the landmark, observation): native ones, and our own."""
    by_kind: dict[LandmarkType, list[tuple[int, int, Observation]]] = {}
    for sighting in sightings:
        by_kind.setdefault(sighting[2].kind, []).append(sighting)
    graph, factors = gtsam.NonlinearFactorGraph(), list[Linearisable]()
    for kind, alike in by_kind.items():
        rows = np.array([[pose, landmark] for pose, landmark, _ in alike], dtype=np.int64)
        observed = np.stack([observation.value for *_, observation in alike])
        made = kind.factors(rows, observed, np.stack([observation.covariance for *_, observation in alike]))
        if isinstance(made, gtsam.NonlinearFactorGraph):
            graph.push_back(made)
        else:
            factors += made
    return graph, factors
