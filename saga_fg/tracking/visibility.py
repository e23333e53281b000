"""Visibility: the probability that a sensor has an object in view, apart from the probability that it exists.

Every frame is asked where it could have detected a track before its misses are held against it. The field of view of
its sensor decides the one half, other objects the other: v = 0 outside, and inside the belief v that the object is
not hidden follows a chain of two states,

    before a frame   v <- g + (v - g) exp(-dt / MEMORY),   g = 1 - HIDING c     c: the share that nearer boxes cover
    missed           v <- v (1 - p_D) / (1 - v p_D)
    detected         v <- 1

so that of a covered object, one miss makes it probable that it is hidden, and stays so while it is missed, whereas one
in plain view has no such excuse. The chance of a detection is r p_D v, with r the existence and p_D the sensor's
detection probability. It decides

    association   a track that nobody can see hardly takes a detection
    existence     r falls by misses only as far as the object should have been seen
    hit ratio     of a hidden object (v below 1/2), a miss is no opportunity
    score         of a box without a detection: times the v of the sensor that sees it best
    report        no box without a detection outside every field of view; an unconfirmed track is reported and deleted
                  by r v, so that false ones do not outlive their misses behind others

Source: Musicki and Evans, Joint Integrated Probabilistic Data Association, IEEE Transactions on Aerospace and
Electronic Systems 40(3), 2004: existence of targets that are observable or not, as a Markov chain.

The share of a box that others cover, as seen from a sensor.

The azimuth interval an object's footprint fills, seen from the sensor, is cut into equal cells, one ray through the
middle of each. A ray enters the object's footprint at range r. A nearer box on the ray of height h, between ranges r0
(where the ray enters it) and r1 (where it leaves), throws a shadow of the sensor, mounted at height H, that reaches

    H + (h - H) r / r1   if h < H,          H + (h - H) r / r0   otherwise

high at range r, on level ground. The share of the object's height above the highest shadow is what is visible on that
ray; the mean over the rays is the visible share.
"""

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, IntArray, wrap_angle
from saga_fg.tracking.measurements import FrameMeasurements
from saga_fg.tracking.tracker_state import TrackerState
from saga_fg.types import Boxes

HIDING = 0.25  # share of covered objects that are hidden; detected are 0.73 to 0.84 of the cars that are detected
# in plain view, 0.5 to 0.85 of the pedestrians (two detectors on nuScenes, KITTI)
SOLID = 0.5  # existence from which a track hides others
WORTH = 0.05  # existence from which it is worth asking whether a track is covered
LOWEST_SENSOR = 1.5  # m above the ground, where the pose does not say so
RAYS = 12


def look(state: TrackerState, measurements: FrameMeasurements) -> None:
    """Note the probability that the sensor of a frame has each track in view, before what it detected is known."""
    table, sensor, pose = state.table, measurements.sensor, measurements.world_T_ego
    now = state.kinematics()
    place = now.position + state.origin
    view = sensor.sees(place, pose).astype(np.float64)
    asked = ((view > 0) & (table.existence >= WORTH)).nonzero()[0]
    if pose is not None and len(asked):
        boxes = state.boxes(now.position, now.velocity)
        eye = (pose @ sensor.extrinsics.ego_T_sensor)[:3, 3]
        ground = np.nanmedian(boxes.position[asked, 2] - np.nan_to_num(boxes.size[asked, 2]) / 2)
        eye[2] = max(eye[2] - ground, LOWEST_SENSOR)
        covered = 1 - visible_share(eye, boxes, asked, solid=table.existence >= SOLID)
        view[asked] -= HIDING * covered
    table.sensors.look(measurements.name, view, state.time - measurements.delay)


def visible_share(
    viewpoint: FloatArray, boxes: Boxes, targets: IntArray, rays: int = RAYS, solid: BoolArray | None = None
) -> FloatArray:
    """The share (K,), from 0 hidden to 1, of boxes[targets] (K,) visible from `viewpoint` (x, y, z), m.

    All boxes stand on the ground z = 0 of the frame they share with the viewpoint. Those of unknown size or heading
    are visible and hide nothing. solid: mask (N,) of the boxes that can hide others, of estimated ones, which hide
    nothing that they overlap; None: all, of true ones.
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
    if solid is not None:
        overlaps &= solid
    target, other = np.nonzero(overlaps)

    cell = (np.arange(rays) + 0.5) / rays
    angle = bearing[targets, None] + low[targets, None] + cell * (high - low)[targets, None]
    own, _ = _crossing(angle, centre[targets], boxes.yaw[targets], boxes.size[targets])
    own = np.where(np.isfinite(own), own, np.linalg.norm(centre[targets], axis=1)[:, None])
    enters, leaves = _crossing(angle[target], centre[other], boxes.yaw[other], boxes.size[other])
    r = own[target]
    rise = boxes.size[other, 2] - viewpoint[2]
    rim = np.where(rise[:, None] < 0, leaves, enters)
    hides = ((enters < r) if solid is None else (leaves <= r)) & np.isfinite(enters)
    with np.errstate(invalid="ignore"):
        shadow = np.where(hides, viewpoint[2] + rise[:, None] * r / np.maximum(rim, 0.1), 0.0)
    highest = np.zeros((len(targets), rays))
    np.maximum.at(highest, target, shadow)
    height = boxes.size[targets, 2][:, None]
    shown = np.clip((height - highest) / height, 0.0, 1.0).mean(axis=1)
    return np.asarray(np.where(np.isfinite(shown), shown, 1.0))


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
