"""The conventions of detections, told by how objects and the vehicle move: frame, headings, speeds; and all findings.

What a table gives is held against how its objects move from frame to frame: a car goes where it is headed, at the speed
that was measured, and objects move less in the world than in the frame of a vehicle that drives. A finding is raised
only where another convention explains the data much better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tables.plausibility import (
    FEWEST,
    far_too_fast,
    length_below_width,
    scores_beyond_one,
    share,
    strange_time_steps,
    unlikely_sizes,
    usual_class,
    within_a_metre,
)
from saga_fg.types.boxes import Boxes
from saga_fg.types.finding import Finding, Mend
from saga_fg.types.frame import Frame

MAX_FRAMES = 200
MIN_STEP = 1e-6  # s between two frames, of which a velocity can be told
SPAN = 0.5  # s of motion, so that the noise of places hardly matters
_MOVES, _WALKS = 2.0, 0.8  # m/s, from which the direction of motion tells the heading, of vehicles and of people
_ASTRAY, _OFF = 0.5, 0.2  # rad between them: of one object, and of half of them
_AWAY = 100.0  # m from the origin, from which what surrounds the vehicle does not surround the origin
_HIT = 1.0  # m between centres that two vehicles cannot have
_DEEP, _FLAT, _NEAR = 8.0, 3.0, 15.0  # m: spread of depths, spread of heights, and the nearest depth before a camera


@dataclass(frozen=True, eq=False)
class Sample:
    """N detections of F frames of one recording.

    time (F,) s, sensor (F,), world_T_ego (F, 4, 4) NaN where unknown, in_world (F,): whether coordinates are "world";
    frame (N,), boxes, score (N,), yaw (N,): headings as they are read, before they are wrapped, rad
    """

    time: FloatArray
    sensor: StrArray
    world_T_ego: FloatArray
    in_world: BoolArray
    frame: IntArray
    boxes: Boxes
    score: FloatArray
    yaw: FloatArray

    @classmethod
    def from_frames(cls, frames: Sequence[Frame], yaw: FloatArray | None = None) -> Self:
        """The first frames of a recording; yaw: of all their detections, before they were wrapped, where known."""
        first = frames[:MAX_FRAMES]
        unknown = np.full((4, 4), np.nan)
        poses = [unknown if frame.world_T_ego is None else frame.world_T_ego for frame in first]
        boxes = Boxes.concatenate([frame.detections.boxes for frame in first])
        return cls(
            time=np.array([frame.timestamp for frame in first]),
            sensor=np.array([frame.sensor for frame in first], dtype=np.str_),
            world_T_ego=np.array(poses).reshape(-1, 4, 4),
            in_world=np.array([frame.coordinates == "world" for frame in first], dtype=np.bool_),
            frame=np.repeat(np.arange(len(first)), [len(frame) for frame in first]),
            boxes=boxes,
            score=np.concatenate([np.empty(0), *(frame.detections.score for frame in first)]),
            yaw=boxes.yaw if yaw is None else yaw[: len(boxes)],
        )

    @classmethod
    def from_rows(cls, time: FloatArray, boxes: Boxes, score: FloatArray, yaw: FloatArray, in_world: BoolArray) -> Self:
        """The first boxes of a recording, at times (N,), s, with headings (N,), rad, before they were wrapped."""
        moments, frame = np.unique(time, return_inverse=True)
        rows = np.flatnonzero(frame < MAX_FRAMES)
        moments = moments[:MAX_FRAMES]
        return cls(
            time=moments,
            sensor=np.full(len(moments), ""),
            world_T_ego=np.full((len(moments), 4, 4), np.nan),
            in_world=np.bincount(frame, ~in_world)[: len(moments)] == 0,
            frame=frame[rows],
            boxes=boxes.select(rows),
            score=score[rows],
            yaw=yaw[rows],
        )

    @cached_property
    def walks(self) -> BoolArray:
        """(N,) whether an object is a pedestrian."""
        return self._of_classes("pedestrian")

    @cached_property
    def stands(self) -> BoolArray:
        """(N,) whether an object is one that never moves."""
        return self._of_classes("barrier")

    def _of_classes(self, ours: str) -> BoolArray:
        names, of_row = np.unique(self.boxes.label, return_inverse=True)
        return np.array([usual_class(name) == ours for name in names.tolist()], dtype=np.bool_)[of_row]

    @cached_property
    def ego(self) -> tuple[FloatArray, FloatArray]:
        """Place (N, 2) and heading (N,) of the vehicle at each detection, NaN where unknown."""
        poses = self.world_T_ego[self.frame]
        return poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])

    def placed(self) -> FloatArray:
        """(N, 2) positions in the world if they are in the vehicle's frame."""
        place, yaw = self.ego
        return place + _turned(self.boxes.position[:, :2], yaw)

    def motion(self, position: FloatArray) -> FloatArray:
        """(N, 2) velocities between frames of positions (N, 2), NaN where they are not clear."""
        return velocities_between_frames(self.time[self.frame], self.boxes.label, position)

    @cached_property
    def world_motion(self) -> FloatArray:
        """(N, 2) velocities between frames, as far as positions are in the world."""
        motion = self.motion(self.boxes.position[:, :2])
        motion[~self.in_world[self.frame]] = np.nan
        return motion


def velocities_between_frames(time: FloatArray, label: StrArray, position: FloatArray) -> FloatArray:
    """Velocities (n, 2) of detections at times (n,), s, and places (n, 2) in the world; NaN where they are not clear.

    That of a detection is over half a second and more, from frame to frame to the nearest of its class, if it is the
    nearest of that in turn, and the second nearest is twice as far.
    """
    from scipy.spatial import cKDTree

    following = np.full(len(time), -1)
    known = np.isfinite(time) & np.isfinite(position).all(axis=1)
    for name in np.unique(label).tolist():
        mine = np.flatnonzero((label == name) & known)
        moments = np.unique(time[mine])[: MAX_FRAMES + 1]
        frames = [mine[time[mine] == moment] for moment in moments]
        for now, later in pairwise(frames):
            distance, nearest = cKDTree(position[later]).query(position[now], k=2)
            _, back = cKDTree(position[now]).query(position[later])
            clear = (back[nearest[:, 0]] == np.arange(len(now))) & (distance[:, 1] > 2 * distance[:, 0])
            clear &= time[later[0]] - time[now[0]] > MIN_STEP
            following[now[clear]] = later[nearest[clear, 0]]
    reached, found = np.arange(len(time)), np.full(position.shape, np.nan)
    for _ in range(MAX_FRAMES):
        short = time[reached] - time < SPAN - MIN_STEP
        short &= following[reached] >= 0
        if not short.any():
            break
        reached[short] = following[reached[short]]
    took = time[reached] - time
    rows = np.flatnonzero((took >= SPAN - MIN_STEP) & known)
    found[rows] = (position[reached[rows]] - position[rows]) / took[rows, None]
    return found


def headings_in_degrees(yaw: FloatArray) -> Finding | None:
    """Headings (n,), as they were given, of which many are beyond a full turn of 2 pi."""
    known = np.abs(yaw[np.isfinite(yaw)])
    beyond = share(known > 2 * np.pi + 0.1)
    if len(known) < FEWEST or beyond < 0.05:
        return None
    what = f"headings look like degrees: {beyond:.0%} of them are beyond 2 pi, the largest is {known.max():.4g}"
    return Finding("degrees", what, "expected rad", Mend(units={"angle": "deg"}))


_CONVENTIONS: dict[str, tuple[str, Callable[[FloatArray], FloatArray]]] = {
    "deg": ("in degrees", np.radians),
    "clockwise": ("clockwise", np.negative),
    "compass_rad": ("clockwise from north", lambda yaw: np.pi / 2 - yaw),
    "clockwise_deg": ("clockwise, in degrees", lambda yaw: -np.radians(yaw)),
    "compass": ("clockwise from north, in degrees", lambda yaw: np.pi / 2 - np.radians(yaw)),
}
"""By unit of angles: what they look like, and the heading that is meant by what was read as rad."""


def headings_against_motion(yaw: FloatArray, velocity: FloatArray, walks: BoolArray) -> Finding | None:
    """Headings (n,), read as rad, of objects that move otherwise, velocities (n, 2), as in another convention.

    walks: whether each is a pedestrian
    """
    moves = (np.hypot(*velocity.T) > np.where(walks, _WALKS, _MOVES)) & np.isfinite(yaw)
    if moves.sum() < 2 * FEWEST:
        return None
    direction, given = np.arctan2(velocity[moves, 1], velocity[moves, 0]), yaw[moves]
    apart = {unit: np.abs(wrap_angle(meant(given) - direction)) for unit, (_, meant) in _CONVENTIONS.items()}
    as_read = np.abs(wrap_angle(given - direction))
    fits = {unit: (share(each > _ASTRAY), float(np.median(each))) for unit, each in apart.items()}
    least = [min(column) for column in zip(*fits.values(), strict=True)]
    best = next(  # the plainest of those that fit alike, as several do on a road along an axis
        (unit for unit, fit in fits.items() if fit[0] <= least[0] + 0.02 and fit[1] <= least[1] + 0.05), "deg"
    )
    now, usual = share(as_read > _ASTRAY), float(np.median(as_read))
    astray, off = fits[best]
    if not (now >= 0.15 and astray <= now / 3) and not (usual > _OFF and off < usual / 3):
        return None
    what = f"headings look {_CONVENTIONS[best][0]}: {now:.0%} of those of moving objects differ from their motion"
    expected = f"expected counter-clockwise from x, rad; read so, {astray:.0%} differ"
    return Finding("headings", what, expected, Mend(units={"angle": best}))


_SPEEDS = {"km/h": 3.6, "ft/s": 3.281, "mph": 2.237}


def speeds_against_motion(velocity: FloatArray, motion: FloatArray) -> Finding | None:
    """Measured velocities (n, 2) which are those between frames (n, 2) in another unit than m/s."""
    moves = (np.hypot(*velocity.T) > 2 * _WALKS) & np.isfinite(motion).all(axis=1)
    if moves.sum() < 2 * FEWEST:
        return None
    measured, moved = velocity[moves], motion[moves]
    weight = (measured**2).sum(axis=1)
    ratio = (measured * moved).sum(axis=1) / weight
    order = np.argsort(ratio)
    middle = order[np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())]  # fast objects tell more
    factor = float(1 / max(ratio[middle], 1e-3))
    unit = min(_SPEEDS, key=lambda unit: abs(np.log(factor / _SPEEDS[unit])))
    if not 0.85 < factor / _SPEEDS[unit] < 1.15:
        return None
    what = f"measured velocities are {factor:.2g} times as large as objects move from frame to frame"
    return Finding("speeds", f"{what}: they look like {unit}", "expected m/s", Mend(units={"speed": unit}))


def camera_axes(position: FloatArray) -> Finding | None:
    """Positions (n, 3) with x to the right, y down and z ahead, as cameras have them."""
    if len(position) < 2 * FEWEST:
        return None
    low, high = np.percentile(position, [5, 95], axis=0)
    ahead = low[2] > 0 and low[2] < _NEAR and high[2] - low[2] > _DEEP
    if not ahead or high[1] - low[1] > _FLAT or high[1] - low[1] > 0.5 * (high[0] - low[0]) or abs(low[1]) > 2 * _FLAT:
        return None
    what = "positions look like those of a camera, x to the right, y down and z ahead: heights differ and y does not"
    return Finding("frame", what, "expected x and y in the plane, and z up", Mend(coordinates="camera"))


def ego_taken_for_world(sample: Sample) -> Finding | None:
    """Positions that are said to be in the world, and move with the vehicle.

    Either they lie about the origin while the vehicle is far from it, or it drives through them. Or, once they are
    placed by the poses of the vehicle, headings or measured velocities fit how they move, or they stay where they were.
    """
    rows = np.flatnonzero(sample.in_world[sample.frame] & np.isfinite(sample.ego[1]))
    if len(rows) < FEWEST:
        return None
    given, placed, ego = sample.boxes.position[:, :2], sample.placed(), sample.ego[0]
    away = rows[np.hypot(*ego[rows].T) > _AWAY]
    if len(away) >= FEWEST:
        about, from_ego = (float(np.median(np.hypot(*each[away].T))) for each in (given, given - ego))
        drives = np.ptp(ego[rows], axis=0).max() > _TRAVELLED
        if about < 0.5 * from_ego if drives else about < 1.5 * _AWAY and from_ego > 3 * _AWAY:
            return _EGO
    hit = [
        share(np.bincount(sample.frame[rows], _within(p[rows], ego[rows]) & ~sample.walks[rows]) > 0)
        for p in (given, placed)
    ]
    if 5 * hit[1] < hit[0] and 0.05 < hit[0] < 0.5:  # more often, it is the vehicle that is detected
        return _EGO
    as_given, as_placed = sample.motion(given), _turned(sample.motion(placed), -sample.ego[1])
    for reading, least in ((_velocity_apart, 0.3), (_heading_apart, 0.12)):
        apart = [reading(sample, motion, rows) for motion in (as_given, as_placed)]
        if min(map(len, apart)) >= 2 * FEWEST:
            one, other = (float(np.median(each)) for each in apart)
            if one > least and other < 0.4 * one:
                return _EGO
            if other > least and one < 0.4 * other:
                return None
    return _EGO if _stay_nearer(sample, rows, given, placed) else None


_EGO = Finding(
    "frame",
    "positions look like coordinates of the vehicle, but are taken for the world: they move with it",
    "expected world coordinates, or coordinates: ego",
    Mend(coordinates="ego"),
)
_TRAVELLED = 3.0  # m of the vehicle, from which it shows what moves with it
_PAIRS = 20  # pairs of frames that are compared


def _within(position: FloatArray, ego: FloatArray) -> BoolArray:
    return np.asarray(np.hypot(*(position - ego).T) < _HIT)


def _velocity_apart(sample: Sample, motion: FloatArray, rows: IntArray) -> FloatArray:
    """m/s between measured velocities and those between frames."""
    apart = np.hypot(*(sample.boxes.velocity - motion)[rows].T)
    return np.asarray(apart[np.isfinite(apart)])


def _heading_apart(sample: Sample, motion: FloatArray, rows: IntArray) -> FloatArray:
    """Rad between headings and motion between frames, of objects that move."""
    least = np.where(sample.walks, _WALKS, _MOVES)
    moves = rows[(np.hypot(*motion.T) > least)[rows] & np.isfinite(sample.yaw)[rows] & ~sample.stands[rows]]
    return np.asarray(np.abs(wrap_angle(sample.yaw[moves] - np.arctan2(motion[moves, 1], motion[moves, 0]))))


def _stay_nearer(sample: Sample, rows: IntArray, given: FloatArray, placed: FloatArray) -> bool:
    """True if objects stay nearer to where they were if they are placed by the poses of the vehicle."""
    from scipy.spatial import cKDTree

    ego, frame = sample.world_T_ego[:, :2, 3], sample.frame
    as_given: list[FloatArray] = []
    as_placed: list[FloatArray] = []
    known = np.unique(frame[rows])
    for name in np.unique(sample.sensor[known]).tolist():
        mine = known[sample.sensor[known] == name]
        for k in mine[:: max(1, len(mine) // _PAIRS)].tolist():
            later = mine[(mine > k) & (np.hypot(*(ego[mine] - ego[k]).T) >= _TRAVELLED)]
            if len(later):
                for position, apart in ((given, as_given), (placed, as_placed)):
                    apart.append(cKDTree(position[frame == later[0]]).query(position[frame == k])[0])
    if sum(len(each) for each in as_given) < FEWEST:
        return False
    stays, moves = float(np.median(np.concatenate(as_placed))), float(np.median(np.concatenate(as_given)))
    return moves > 1.0 and stays < 0.5 * moves


def _turned(vectors: FloatArray, yaw: FloatArray) -> FloatArray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def findings_of(sample: Sample, logits: Callable[[str], bool] = lambda sensor: False) -> list[Finding]:
    """All that is doubtful in a sample. `logits` says of which sensors the scores are declared as such.

    What is seen of motion is left out where times, lengths or the frame are doubtful already.
    """
    boxes, label = sample.boxes, sample.boxes.label
    declared = {name: logits(name) for name in np.unique(sample.sensor).tolist()}
    shares = np.array([not declared[name] for name in sample.sensor.tolist()], dtype=np.bool_)[sample.frame]
    scale = (
        strange_time_steps(sample.time, sample.sensor),
        unlikely_sizes(label, boxes.size),
        within_a_metre(sample.frame, boxes.position),
    )
    found = [scores_beyond_one(sample.score[shares]), length_below_width(label, boxes.size), *scale]
    if not any(scale):
        found.append(camera_axes(boxes.position[~np.isnan(boxes.position).any(axis=1)]) or ego_taken_for_world(sample))
    degrees = headings_in_degrees(sample.yaw)
    if not any(scale) and found[-1] is None:
        measured = np.isfinite(boxes.velocity).any(axis=1)
        known = measured & ~sample.stands
        motion = np.where(known[:, None], boxes.velocity, np.where(sample.stands[:, None], np.nan, sample.world_motion))
        headings = headings_against_motion(sample.yaw, motion, sample.walks)
        speeds = speeds_against_motion(boxes.velocity, sample.world_motion) or far_too_fast(label, boxes.velocity)
        found += [headings or degrees, speeds]
    else:
        found += [degrees, far_too_fast(label, boxes.velocity)]
    return [finding for finding in found if finding is not None]
