"""Keyframes of a planar laser, and what registrations between them are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.laser.line_map import SMEAR, Fit
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import moved, transform
from saga_fg.slam.pose_graph.running import Measured

_FLOOR = np.array([0.01, 0.01, 0.002]) ** 2  # variance of a registration of any number of points, m^2 and rad^2
_DETERMINED = 0.05  # ratio of information along and across below which a place is a bare corridor


@dataclass(eq=False)
class Keyframe:
    """A scan (n, 2) of the graph, its pose by scan matching alone, the row of the scan, and the way until there, m."""

    points: FloatArray
    matched: FloatArray
    row: int
    way: float


def joined(frames: Sequence[Keyframe], centre: Keyframe) -> FloatArray:
    """Points (n, 2) of keyframes in the frame of `centre`."""
    back = np.linalg.inv(centre.matched)
    return np.concatenate([moved(frame.points, back @ frame.matched) for frame in frames])


def measured_by(first: int, second: int, fit: Fit) -> Measured:
    """The measurement between two keyframes by a registration."""
    measured = transform(fit.pose)
    return Measured(first, second, measured, covariance_of(_firm(fit.information) / SMEAR, measured))


def determined(information: FloatArray) -> bool:
    """True if a registration determines the place in all directions: not along a bare corridor."""
    values = np.linalg.eigvalsh(information[:2, :2])
    return bool(values[0] > _DETERMINED * values[1])


def _firm(information: FloatArray) -> FloatArray:
    """Information without what scatter seems to say along a bare corridor."""
    values, vectors = np.linalg.eigh(information[:2, :2])
    ratio = values[0] / max(values[1], 1e-9)
    if ratio >= _DETERMINED:
        return information
    S = np.eye(3)
    S[:2, :2] -= (1 - max(ratio, 0.0) / _DETERMINED) * np.outer(vectors[:, 0], vectors[:, 0])
    return np.asarray(S @ information @ S)


def covariance_of(information: FloatArray, pose: FloatArray) -> FloatArray:
    """Covariance in the pose's own frame of what is known in the axes of the map."""
    R = np.eye(3)
    R[:2, :2] = pose[:2, :2]
    own = R.T @ np.linalg.inv(information + np.diag([1e-3, 1e-3, 1e-3])) @ R
    return np.asarray((own + own.T) / 2 + np.diag(_FLOOR))
