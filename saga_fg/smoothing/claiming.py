"""Detections that no track took, claimed by the smoothed object that explains them.

A tracker has no track yet where an object first shows itself by weak detections, and none any more after an
occlusion. A smoother reaches there from the object's later and earlier states: look by look, what is free is assigned
to the objects that have nothing yet at that look.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import IntArray
from saga_fg.smoothing.attribution import attribute
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.states import Lives, StateTable


def claim_detections(
    evidence: Evidence,
    object_of: IntArray,
    lives: Lives,
    states: StateTable,
    share: float,
    max_distance: float,
) -> IntArray:
    """(N,) the object of each detection after the claims; none loses its object.

    share: of true pairs that the gate lets through; max_distance: between a state and a detection, m
    """
    result = object_of.copy()
    for look, rows in zip(evidence.looks, evidence.rows_of_look(), strict=True):
        free = rows.start + np.flatnonzero(result[rows] < 0)
        there = states.at(look.moment)
        ids = states.id[there]
        open_ = ~np.isin(ids, result[rows])
        if len(free) == 0 or not open_.any():
            continue
        ids, mean, P = ids[open_], states.mean[there][open_], states.covariance[there][open_]
        objects, detections = attribute(
            lives.label[lives.rows_of(ids)],
            mean[:, :2],
            P[:, :2, :2],
            evidence.boxes.label[free],
            evidence.boxes.position[free, :2],
            evidence.R[free, :2, :2],
            share,
            np.full(len(ids), max_distance),
        )
        result[free[detections]] = ids[objects]
    return result
