"""Objects as KITTI writes them, and their boxes between the camera frame and the world.

KITTI gives a box by the centre of its *bottom* face in the rectified camera frame (x right, y down, z ahead), its
height, width and length, and `rotation_y`, the heading about the camera's y axis: 0 along x, growing from z to -x, so
that the heading points along (cos r, 0, -sin r). Upright in the camera frame, it leans in the world by the camera's
tilt; its world box stands on the same centre with the heading's horizontal direction:

    centre = world_T_camera (location - (0, h/2, 0)),    yaw = direction of M (cos r, sin r),

M being the horizontal part of the map of the heading. M is invertible, so the way back is exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.numerics import BoolArray, Columns, FloatArray, IntArray, StrArray, inverse_transform, wrap_angle
from saga_fg.types import Boxes

_NO_BOX = -999.0  # positions below: the object has no 3D box


@dataclass(frozen=True, eq=False)
class CameraBoxes(Columns):
    """N boxes in the rectified camera frame.

    size        (N, 3)  height, width, length, m (KITTI's order)
    location    (N, 3)  centre of the bottom face, m
    rotation_y  (N,)    rad
    """

    size: FloatArray
    location: FloatArray
    rotation_y: FloatArray

    def corners(self) -> FloatArray:
        """Corners (N, 8, 3) in the camera frame: the four of the bottom in turn, then the four above them."""
        height, width, length = self.size.T
        along = length[:, None] / 2 * np.array([1, 1, -1, -1, 1, 1, -1, -1])
        across = width[:, None] / 2 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
        down = -height[:, None] * np.array([0, 0, 0, 0, 1, 1, 1, 1])
        c, s = np.cos(self.rotation_y)[:, None], np.sin(self.rotation_y)[:, None]
        return np.asarray(
            self.location[:, None, :] + np.stack([c * along + s * across, down, -s * along + c * across], axis=-1)
        )


@dataclass(frozen=True, eq=False)
class KittiObjects(Columns):
    """Objects of a sequence, N lines as columns, in the order of the file.

    frame (N,), track_id (N,), type (N,) as in the file, truncated (N,), occluded (N,), alpha (N,), bbox (N, 4) left,
    top, right, bottom, boxes (N), score (N,) NaN where there is none.
    """

    frame: IntArray
    track_id: IntArray
    type: StrArray
    truncated: FloatArray
    occluded: FloatArray
    alpha: FloatArray
    bbox: FloatArray
    boxes: CameraBoxes
    score: FloatArray


def has_box(objects: KittiObjects) -> BoolArray:
    """Mask (N,) of the objects with a 3D box; `DontCare` regions and results of image trackers have none."""
    return np.asarray((objects.type != "DontCare") & (objects.boxes.location > _NO_BOX).all(axis=1))


def camera_boxes_to_world(boxes: CameraBoxes, label: StrArray | Sequence[str], world_T_camera: FloatArray) -> Boxes:
    """The boxes in world coordinates; `world_T_camera` is (4, 4), or (N, 4, 4) with a pose for every box.

    Their velocities are unknown. Raises `InputError` for boxes that are not finite or have no positive size.
    """
    n = len(boxes)
    T = np.broadcast_to(world_T_camera, (n, 4, 4))
    height, width, length = boxes.size.T
    centre = boxes.location - np.stack([np.zeros(n), height / 2, np.zeros(n)], axis=-1)
    heading = _horizontal_map(T) @ np.stack([np.cos(boxes.rotation_y), np.sin(boxes.rotation_y)], axis=-1)[..., None]
    return Boxes.of(
        label,
        (T[:, :3, :3] @ centre[..., None])[..., 0] + T[:, :3, 3],
        np.stack([length, width, height], axis=-1),
        np.arctan2(heading[:, 1, 0], heading[:, 0, 0]),
    )


def world_boxes_to_camera(boxes: Boxes, world_T_camera: FloatArray) -> CameraBoxes:
    """The way back; `world_T_camera` is (4, 4), or (N, 4, 4) with a pose for every box."""
    n = len(boxes)
    T = np.broadcast_to(world_T_camera, (n, 4, 4))
    camera_T_world = inverse_transform(T)
    centre = (camera_T_world[:, :3, :3] @ boxes.position[..., None])[..., 0] + camera_T_world[:, :3, 3]
    length, width, height = boxes.size.T
    direction = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], axis=-1)[..., None]
    turned = np.linalg.solve(_horizontal_map(T), direction)
    return CameraBoxes(
        size=np.stack([height, width, length], axis=-1),
        location=centre + np.stack([np.zeros(n), height / 2, np.zeros(n)], axis=-1),
        rotation_y=wrap_angle(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])),
    )


def _horizontal_map(world_T_camera: FloatArray) -> FloatArray:
    """M (N, 2, 2): (cos r, sin r) to the horizontal part of the heading in the world."""
    return np.stack([world_T_camera[:, :2, 0], -world_T_camera[:, :2, 2]], axis=-1)
