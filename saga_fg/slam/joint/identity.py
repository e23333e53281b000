"""Identity of detections: the probability that each one is of the object that it is assigned to.

A detection z assigned to object i may be of another object k of its class, or of none that is known (clutter). With the
objects where they are estimated, seen from the vehicle,

    p_i = g_i / (g_c + sum_k g_k),   g_k = exp(-1/2 (z - h_k)^T S^-1 (z - h_k)),   S = R + spread^2 I

    g_c = 2 pi sqrt(|S|) / clutter_area

The estimate of the objects comes from the whole window, so that what an object does before and afterwards counts. In
the graph the detection has a share p_i of its information: one that fits a neighbour as well hardly bends the path.
Source of the probabilities: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), section 6.6, probabilistic data association.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import inverse_transform, transform_points
from saga_fg.slam.joint.record import RecordedEpoch

_SPREAD = 0.2  # m, standard deviation of the estimated positions of objects
_LEAST = 0.01  # so that no object is without information
_FAR = 50.0  # squared deviations from which a pair says no more


def with_identities(
    now: RecordedEpoch, world_T_ego: FloatArray, position: FloatArray, clutter_area: float
) -> RecordedEpoch:
    """The epoch with the probabilities of its assignments.

    world_T_ego: (4, 4); position: (n, 2) of its objects in the world, m; clutter_area: m^2, inf without clutter
    """
    seen, objects = now.seen, now.objects
    if not len(seen.id):
        return now
    placed = np.column_stack([position, np.zeros(len(position))])
    placed[:, 2] = transform_points(world_T_ego, seen.z)[:, 2].mean()
    beside = transform_points(inverse_transform(world_T_ego), placed)[:, :2]
    S = seen.R + _SPREAD**2 * np.eye(2)
    off = seen.z[:, None, :2] - beside
    squared = np.einsum("mni,mij,mnj->mn", off, np.linalg.inv(S), off)
    own = np.searchsorted(objects.id, seen.id)
    label = np.array(objects.label)
    rival = label[own][:, None] == label[None]
    g = np.where(rival, np.exp(-np.minimum(squared, _FAR) / 2), 0.0)
    clutter = 2 * np.pi * np.sqrt(np.linalg.det(S)) / clutter_area
    p = g[np.arange(len(own)), own] / (clutter + g.sum(axis=1))
    return replace(now, seen=replace(seen, probability=np.maximum(p, _LEAST)))


def with_all_identities(
    record: Sequence[RecordedEpoch], path: FloatArray, positions: Sequence[FloatArray], clutter_area: float
) -> list[RecordedEpoch]:
    """The epochs of a path (n, 4, 4) likewise; positions: (k, 2) of the objects of each."""
    return [
        with_identities(now, pose, position, clutter_area)
        for now, pose, position in zip(record, path, positions, strict=True)
    ]
