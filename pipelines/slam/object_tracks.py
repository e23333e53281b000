"""Tracks of the objects of a joint estimate, in world coordinates: tracks.csv, a row for each object and moment.

timestamp (s), id, class, x, y (m), vx, vy (m/s), and the standard deviations of the last four
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.joint import JointEstimate


def tracks(estimate: JointEstimate) -> dict[int, FloatArray]:
    """Places (n, 2), m, of each object, by id, from first to last."""
    found: dict[int, list[FloatArray]] = {}
    for objects in estimate.objects:
        for name, place in zip(objects.id.tolist(), objects.position, strict=True):
            found.setdefault(name, []).append(place)
    return {name: np.array(places) for name, places in found.items()}


def tracks_csv(estimate: JointEstimate) -> str:
    """The text of tracks.csv."""
    rows = ["timestamp,id,class,x,y,vx,vy,sigma_x,sigma_y,sigma_vx,sigma_vy"]
    for moment, (time, objects) in enumerate(zip(estimate.timestamps, estimate.objects, strict=True)):
        sigma = np.sqrt(np.diagonal(estimate.object_covariances(moment), axis1=1, axis2=2))
        table = np.concatenate([objects.position, objects.velocity, sigma], axis=1)
        rows += [
            f"{time:.6f},{name},{label}," + ",".join(f"{x:.4f}" for x in row)
            for name, label, row in zip(objects.id.tolist(), objects.label, table, strict=True)
        ]
    return "\n".join(rows) + "\n"
