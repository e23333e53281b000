"""Boxes of the camera frame in the image: 2D boxes and observation angles.

The 2D box encloses the projection of the twelve edges, cut at a plane just before the camera, and is clipped to the
image. The observation angle is alpha = rotation_y - atan2(x, z). Pixels count from 0.
"""

from __future__ import annotations

import numpy as np

from data_tools.kitti_objects import CameraBoxes
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import wrap_angle

NEAREST = 0.1  # m ahead of the camera where edges are cut

_FROM = np.array([0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3])
_TO = np.array([1, 2, 3, 0, 5, 6, 7, 4, 4, 5, 6, 7])


def image_boxes(boxes: CameraBoxes, projection: FloatArray, image_size: tuple[int, int]) -> FloatArray:
    """2D boxes (N, 4): left, top, right, bottom in pixels; NaN for a box that does not show.

    projection (3, 4) is P2; image_size is width, height in pixels.
    """
    corners = boxes.corners()
    start, end = corners[:, _FROM], corners[:, _TO]  # (N, 12, 3)
    depth_start, depth_end = start[..., 2], end[..., 2]
    span = depth_end - depth_start
    crossing = (NEAREST - depth_start) / np.where(span == 0, 1.0, span)
    cut = start + crossing[..., None] * (end - start)
    visible = (depth_start >= NEAREST) | (depth_end >= NEAREST)
    start = np.where((depth_start < NEAREST)[..., None], cut, start)
    end = np.where((depth_end < NEAREST)[..., None], cut, end)
    points = np.concatenate([start, end], axis=1)  # (N, 24, 3)
    ahead = np.concatenate([visible, visible], axis=1)[..., None]
    image = points @ projection[:, :3].T + projection[:, 3]
    pixels = image[..., :2] / np.where(ahead, image[..., 2:], 1.0)
    low = np.where(ahead, pixels, np.inf).min(axis=1)
    high = np.where(ahead, pixels, -np.inf).max(axis=1)
    last = np.array(image_size) - 1.0
    shows = ((high > 0) & (low < last)).all(axis=1)
    result = np.concatenate([np.clip(low, 0, last), np.clip(high, 0, last)], axis=1)
    result[~shows] = np.nan
    return result


def observation_angles(boxes: CameraBoxes) -> FloatArray:
    """alpha (N,), rad, in [-pi, pi)."""
    return wrap_angle(boxes.rotation_y - np.arctan2(boxes.location[:, 0], boxes.location[:, 2]))
