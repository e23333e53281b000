"""A camera above flat ground: image boxes as objects on the ground, and back.

    (X, Y, 1) ~ H (u, v, 1),    inv(H) = K [r_1 r_2 t]

takes the pixel (u, v) where an object stands, the middle of the lower edge of its box, to its place (X, Y). K has the
focal length and the centre of the image, r_1, r_2 and t are columns of the pose of the world in the camera. With the
derivative J of the place by the pixel, a foot point of covariance s^2 I has the place's covariance s^2 J J^T, to first
order. A pixel is |J e_u| wide at the foot, and as high, as objects stand upright before the camera.

Source: Hartley and Zisserman, Multiple View Geometry, 2004, sections 8.1 and 5.2 (first-order propagation).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray, StrArray, checked
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.settings import Finite, Positive, Settings, setting
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections

FARTHEST = 1e4  # m; the ground beyond is at the horizon
_BELOW = 1e4  # px down, where the ground is in every image that shows some
_LEAST_DEVIATION = 1.0  # px of a foot point
_LARGEST_CONDITION = 1e15  # of a homography, from which its inverse has no digit left


@dataclass(frozen=True)
class GroundCamera(Settings):
    """A camera that stands still above flat ground, by a homography or by its lens and pose.

    The world has x ahead of the camera at yaw 0, y to the left and z up; its ground is z = 0.
    """

    homography: tuple[tuple[float, float, float], ...] | None = setting(
        None, "three rows of the homography from pixels to places on the ground, m; null: by focal length and pose"
    )
    focal_length: Positive = setting(1000.0, "focal length, px")
    centre: tuple[float, float] = setting((960.0, 540.0), "principal point (u, v), px; usual: the middle of the image")
    x: Finite = setting(0.0, "place of the camera, m")
    y: Finite = setting(0.0, "place of the camera, m")
    height: Positive = setting(5.0, "height of the camera above the ground, m")
    yaw: Finite = setting(0.0, "direction of view about z, from x towards y, rad")
    pitch: Finite = setting(0.2, "angle of the view below the horizon, rad; higher: looks further down")
    roll: Finite = setting(0.0, "angle about the direction of view, rad; higher: the camera turns clockwise")
    deviation: Positive = setting(
        0.05, "standard deviation of a foot point as a share of the height of its box; usual 0.02 to 0.1"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.ground_H_image

    @cached_property
    def ground_H_image(self) -> FloatArray:
        """H (3, 3), of which (0, 0, 1) H (u, v, 1) is above 0 where the pixel shows the ground."""
        if self.homography is not None:
            H = _invertible(checked("homography", self.homography, (3, 3)))
            return np.asarray(H * np.sign(H[2] @ [0.0, _BELOW, 1.0]))
        down, side = (
            np.array([np.cos(self.pitch), np.sin(self.pitch)]),
            np.array([np.cos(self.roll), np.sin(self.roll)]),
        )
        level = np.array([[0.0, -1.0, 0.0], [-down[1], 0.0, -down[0]], [down[0], 0.0, -down[1]]])
        turned = np.array([[side[0], side[1], 0.0], [-side[1], side[0], 0.0], [0.0, 0.0, 1.0]])
        camera_R_world = turned @ level @ yaw_transform(0.0, 0.0, 0.0, self.yaw)[:3, :3].T
        K = np.array([[self.focal_length, 0, self.centre[0]], [0, self.focal_length, self.centre[1]], [0, 0, 1]])
        with np.errstate(over="ignore", invalid="ignore"):
            t = -camera_R_world @ [self.x, self.y, self.height]
            image_H_ground = K @ np.column_stack([camera_R_world[:, :2], t])
        return np.asarray(np.linalg.inv(_invertible(image_H_ground)))

    def places(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 2) on the ground at pixels (n, 2), m, NaN beyond the horizon, and their derivatives (n, 2, 2)."""
        h = np.column_stack([pixels, np.ones(len(pixels))]) @ self.ground_H_image.T
        with np.errstate(divide="ignore", invalid="ignore"):
            place = h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan)
            place[~(np.hypot(*place.T) < FARTHEST)] = np.nan
            J = (self.ground_H_image[:2, :2] - place[:, :, None] * self.ground_H_image[2, :2]) / h[:, 2, None, None]
        return place, J

    def detections(self, xyxy: FloatArray, score: FloatArray, label: StrArray) -> tuple[Detections, IntArray]:
        """Image boxes (n, 4), px, that stand on the ground, as detections in the world, and their rows (k,).

        Raises `InputError` for boxes that are no boxes, naming the row.
        """
        xyxy = checked("xyxy", xyxy, (len(label), 4))
        extent = xyxy[:, 2:] - xyxy[:, :2]
        if (extent <= 0).any():
            row = int(np.argmax((extent <= 0).any(axis=1)))
            raise InputError(f"xyxy[{row}]: expected left < right and top < bottom, got {xyxy[row].tolist()}")
        place, J = self.places(np.column_stack([xyxy[:, [0, 2]].mean(axis=1), xyxy[:, 3]]))
        rows = np.flatnonzero(np.isfinite(place[:, 0]))
        place, J = place[rows], J[rows]
        width, height = (extent[rows] * np.hypot(*J[:, :, 0].T)[:, None]).T
        sigma = np.maximum(self.deviation * extent[rows, 1], _LEAST_DEVIATION)
        P = sigma[:, None, None] ** 2 * J @ np.swapaxes(J, 1, 2)
        boxes = Boxes.of(label[rows], np.column_stack([place, height / 2]), np.column_stack([width, width, height]))
        return Detections(boxes, score[rows], position_covariance=P), rows

    def image_boxes(self, boxes: Boxes) -> FloatArray:
        """The image boxes (n, 4), px, of objects in the world; NaN for those behind the camera or of unknown size."""
        h = np.column_stack([boxes.position[:, :2], np.ones(len(boxes))]) @ np.linalg.inv(self.ground_H_image).T
        foot = h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan)
        _, J = self.places(foot)
        width, height = boxes.size[:, 1:].T / np.hypot(*J[:, :, 0].T)
        left, low = foot[:, 0] - width / 2, foot[:, 1]
        return np.column_stack([left, low - height, left + width, low])


def _invertible(H: FloatArray) -> FloatArray:
    """A homography (3, 3). Raises `InputError` for one that is singular in double precision."""
    if not (np.isfinite(H).all() and np.linalg.cond(H) < _LARGEST_CONDITION):
        raise InputError("expected a camera that sees the ground, by a homography that can be inverted")
    return H
