"""Visible share of an object behind other objects, as seen from a sensor.

The azimuth interval an object's footprint fills, seen from the sensor, is cut into equal cells, one ray through the
middle of each. A ray enters the object's footprint at range r. A nearer box on the ray of height h, between ranges r0
(where the ray enters it) and r1 (where it leaves), throws a shadow of the sensor, mounted at height H, that reaches

    H + (h - H) r / r1   if h < H,          H + (h - H) r / r0   otherwise

high at range r, on level ground. The share of the object's height above the highest shadow is what is visible on that
ray; the mean over the rays is the visible share.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.types.boxes import Boxes

RAYS = 12


def visible_share(viewpoint: FloatArray, boxes: Boxes, targets: IntArray, rays: int = RAYS) -> FloatArray:
    """The share (K,), from 0 hidden to 1, of boxes[targets] (K,) visible from `viewpoint` (x, y, z), m.

    All boxes stand on the ground z = 0 of the frame they share with the viewpoint, and all can hide others.
    """
    if len(targets) == 0:
        return np.empty(0)
    centre = boxes.position[:, :2] - viewpoint[:2]
    bearing = np.arctan2(centre[:, 1], centre[:, 0])
    corners = boxes.corners() - viewpoint[:2]
    spread = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    low, high = spread.min(axis=1), spread.max(axis=1)
    reach = np.linalg.norm(corners, axis=-1).max(axis=1)
    nearest = np.linalg.norm(centre, axis=1) - np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2

    between = wrap_angle(bearing[None, :] - bearing[targets, None])
    overlaps: BoolArray = (
        (between + low[None, :] < high[targets, None])
        & (between + high[None, :] > low[targets, None])
        & (nearest[None, :] < reach[targets, None])
    )
    overlaps |= nearest[None, :] < 0.5  # a box beside the sensor may fill more than half the circle
    overlaps[np.arange(len(targets)), targets] = False
    target, other = np.nonzero(overlaps)

    cell = (np.arange(rays) + 0.5) / rays
    angle = bearing[targets, None] + low[targets, None] + cell * (high - low)[targets, None]
    own, _ = _crossing(angle, centre[targets], boxes.yaw[targets], boxes.size[targets])
    own = np.where(np.isfinite(own), own, np.linalg.norm(centre[targets], axis=1)[:, None])
    enters, leaves = _crossing(angle[target], centre[other], boxes.yaw[other], boxes.size[other])
    r = own[target]
    rise = boxes.size[other, 2] - viewpoint[2]
    rim = np.where(rise[:, None] < 0, leaves, enters)
    hides = (enters < r) & np.isfinite(enters)
    with np.errstate(invalid="ignore"):
        shadow = np.where(hides, viewpoint[2] + rise[:, None] * r / np.maximum(rim, 0.1), 0.0)
    highest = np.zeros((len(targets), rays))
    np.maximum.at(highest, target, shadow)
    height = boxes.size[targets, 2][:, None]
    return np.asarray(np.clip((height - highest) / height, 0.0, 1.0).mean(axis=1))


def _crossing(
    angle: FloatArray, centre: FloatArray, yaw: FloatArray, size: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ranges (P, rays) at which rays from the origin enter and leave P rectangles; inf where they miss."""
    c, s = np.cos(yaw), np.sin(yaw)
    origin = np.stack([-(c * centre[:, 0] + s * centre[:, 1]), s * centre[:, 0] - c * centre[:, 1]], axis=-1)
    local = angle - yaw[:, None]
    direction = np.stack([np.cos(local), np.sin(local)], axis=-1)
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    half = size[:, None, :2] / 2
    first, second = (-half - origin[:, None]) / direction, (half - origin[:, None]) / direction
    enters = np.minimum(first, second).max(axis=-1)
    leaves = np.maximum(first, second).min(axis=-1)
    hit = (enters <= leaves) & (leaves > 0)
    return np.where(hit, np.maximum(enters, 0.0), np.inf), np.where(hit, leaves, np.inf)
