"""The conventions of detections, told by how objects and the vehicle move: frame, headings, speeds; and all findings.

What a table gives is held against how its objects move from frame to frame: a car goes where it is headed, at the speed
that was measured, and objects move less in the world than in the frame of a vehicle that drives. A finding is raised
only where another convention explains the data much better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np

from saga_fg.numerics import BoolArray, FloatArray, IntArray, StrArray, wrap_angle, yaw_of
from saga_fg.tables.plausibility import (
    FEWEST,
    far_too_fast,
    length_below_width,
    repeated_rows,
    scores_beyond_one,
    share,
    strange_time_steps,
    unlikely_sizes,
    usual_class,
    within_a_metre,
)
from saga_fg.tables.velocities import (
    ALIKE,
    MAX_FRAMES,
    MIN_STEP,
    MOVES,
    SPAN,
    WALKS,
    rotated,
    shared_motion,
    velocities_against_motion,
    velocities_between_frames,
)
from saga_fg.types import Boxes, Finding, Frame, Mend

_ASTRAY, _OFF = 0.5, 0.2  # rad between them: of one object, and of half of them
_AWAY = 100.0  # m from the origin, from which what surrounds the vehicle does not surround the origin
_DEEP, _FLAT, _NEAR = 8.0, 3.0, 40.0  # m: spread of depths, spread of heights, and the nearest depth before a camera


@dataclass(frozen=True, eq=False)
class Sample:
    """N detections of F frames of one recording.

    time (F,) s, sensor (F,), coordinates (F,), world_T_ego (F, 4, 4) NaN where unknown; frame (N,), boxes, score (N,),
    yaw (N,), ego_yaw (F,): headings of objects and vehicle as they are read, before they are wrapped, rad
    """

    time: FloatArray
    sensor: StrArray
    world_T_ego: FloatArray
    coordinates: StrArray
    frame: IntArray
    boxes: Boxes
    score: FloatArray
    yaw: FloatArray
    ego_yaw: FloatArray

    @classmethod
    def from_frames(
        cls, frames: Sequence[Frame], yaw: FloatArray | None = None, ego_yaw: FloatArray | None = None
    ) -> Self:
        """The first frames; yaw, ego_yaw: of all detections and frames, before they were wrapped, where known."""
        first = frames[:MAX_FRAMES]
        unknown = np.full((4, 4), np.nan)
        poses = [unknown if frame.world_T_ego is None else frame.world_T_ego for frame in first]
        boxes = Boxes.concatenate([frame.detections.boxes for frame in first])
        return cls(
            time=np.array([frame.timestamp for frame in first]),
            sensor=np.array([frame.sensor for frame in first], dtype=np.str_),
            world_T_ego=np.array(poses).reshape(-1, 4, 4),
            coordinates=np.array([frame.coordinates for frame in first], dtype=np.str_),
            frame=np.repeat(np.arange(len(first)), [len(frame) for frame in first]),
            boxes=boxes,
            score=np.concatenate([np.empty(0), *(frame.detections.score for frame in first)]),
            yaw=boxes.yaw if yaw is None else yaw[: len(boxes)],
            ego_yaw=yaw_of(np.array(poses).reshape(-1, 4, 4)) if ego_yaw is None else ego_yaw[:MAX_FRAMES],
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
            coordinates=np.where(np.bincount(frame, ~in_world)[: len(moments)] == 0, "world", "sensor"),
            frame=frame[rows],
            boxes=boxes.select(rows),
            score=score[rows],
            yaw=yaw[rows],
            ego_yaw=np.full(len(moments), np.nan),
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
        return place + rotated(self.boxes.position[:, :2], yaw)

    def motion(self, position: FloatArray) -> FloatArray:
        """(N, 2) velocities between frames of positions (N, 2), NaN where they are not clear."""
        return velocities_between_frames(self.time[self.frame], self.boxes.label, position)

    @cached_property
    def own_motion(self) -> FloatArray:
        """(N, 2) velocities over ground between frames, along the axes in which boxes are given, NaN where unknown."""
        given = self.coordinates[self.frame]
        of_ego = (given == "ego")[:, None]
        motion = self.motion(np.where(of_ego, self.placed(), self.boxes.position[:, :2]))
        motion = np.where(of_ego, rotated(motion, -self.ego[1]), motion)
        motion[given == "sensor"] = np.nan
        return motion

    @cached_property
    def ego_motion(self) -> FloatArray:
        """(F, 2) velocity of the vehicle, over half a second and more, NaN where unknown."""
        later = np.searchsorted(self.time, self.time + SPAN - MIN_STEP)
        found = np.full((len(self.time), 2), np.nan)
        rows = np.flatnonzero(later < len(self.time))
        place, took = self.world_T_ego[:, :2, 3], self.time[later[rows]] - self.time[rows]
        found[rows] = (place[later[rows]] - place[rows]) / took[:, None]
        return found


def headings_in_degrees(yaw: FloatArray, column: Literal["angle", "ego_yaw"] = "angle") -> Finding | None:
    """Headings (n,) as they were given, many of them beyond a full turn of 2 pi; column: of all, or of the vehicle."""
    known = np.abs(yaw[np.isfinite(yaw)])
    beyond = share(known > 2 * np.pi + 0.1)
    if len(known) < FEWEST or beyond < 0.05:
        return None
    whose = "headings" if column == "angle" else "headings of the vehicle"
    what = f"{whose} look like degrees: {beyond:.0%} of them are beyond 2 pi, the largest is {known.max():.4g}"
    return Finding(f"{column} in degrees", what, "expected rad", Mend(units={column: "deg"}))


_CONVENTIONS: dict[str, tuple[str, Callable[[FloatArray], FloatArray]]] = {
    "deg": ("in degrees", np.radians),
    "clockwise": ("clockwise", np.negative),
    "compass_rad": ("clockwise from north", lambda yaw: np.pi / 2 - yaw),
    "clockwise_deg": ("clockwise, in degrees", lambda yaw: -np.radians(yaw)),
    "compass": ("clockwise from north, in degrees", lambda yaw: np.pi / 2 - np.radians(yaw)),
}
"""By unit of angles: what they look like, and the heading that is meant by what was read as rad."""


class HeadingFit(NamedTuple):
    """How headings fit motion.

    unit  that of `_CONVENTIONS` by which they do; "rad": as they are read; "world": less the heading of the frame that
          they are given in; "": by none
    said  how far they are off as they are read
    sure  False where the unit fits a little better alone, and they are not far off as they are read
    """

    unit: str
    said: str
    sure: bool = True


def fitting_convention(
    yaw: FloatArray, velocity: FloatArray, walks: BoolArray, axes: FloatArray | None = None
) -> HeadingFit | None:
    """How headings (n,), read as rad, fit objects that move with `velocity` (n, 2); None where too few move.

    axes  (n,) heading of the frame that they are given in, rad
    """
    moves = (np.hypot(*velocity.T) > np.where(walks, WALKS, MOVES)) & np.isfinite(yaw)
    if moves.sum() < 2 * FEWEST:
        return None
    direction, given = np.arctan2(velocity[moves, 1], velocity[moves, 0]), yaw[moves]
    world = {} if axes is None else {"world": given - axes[moves]}
    meant = {"rad": given, **world, **{unit: convert(given) for unit, (_, convert) in _CONVENTIONS.items()}}
    apart = {unit: np.abs(wrap_angle(each - direction)) for unit, each in meant.items()}
    fits = {unit: (share(each > _ASTRAY), float(np.median(each))) for unit, each in apart.items()}
    least = [min(column) for column in zip(*fits.values(), strict=True)]
    best = next(  # the plainest of those that fit alike, as several do on a road along an axis
        (unit for unit, fit in fits.items() if fit[0] <= least[0] + 0.02 and fit[1] <= least[1] + 0.05), "rad"
    )
    now, usual = fits["rad"]
    said = f"{now:.0%} of those of moving objects differ from their motion, half of them by {usual:.2g} rad and more"
    astray, off = fits[best]
    turned = np.abs(wrap_angle(2 * (given - direction))) / 2  # by something else than half a turn
    better = (now >= 0.15 and astray <= now / 3) or (usual > _OFF and off < usual / 3)
    better &= now > 0.5 or share(turned > _ASTRAY) > 0.1 or float(np.median(turned)) > _OFF  # not some turned round
    if better and astray < 0.2 and off < _OFF:
        return HeadingFit(best, said)
    constant = np.ptp(given) < 1e-6
    if best in _CONVENTIONS and not constant and usual > max(2 * off, 0.08):  # as of mirrored ones nearly along an axis
        return HeadingFit(best, said, sure=False)
    if now > 0.5 and (constant or not walks[moves].any()):
        return HeadingFit("", said)
    return HeadingFit("rad", said) if now < 0.15 and usual < _OFF else None


def headings_against_motion(sample: Sample, motion: FloatArray) -> Finding | None:
    """Headings of objects that move otherwise, `motion` (N, 2), as in another convention or none.

    Where motion tells nothing, headings beyond a full turn, as in degrees.
    """
    axes = np.where(sample.coordinates[sample.frame] == "ego", sample.ego[1], 0.0)
    of_objects = fitting_convention(sample.yaw, motion, sample.walks, axes)
    slow = np.ones(len(sample.time), dtype=np.bool_)  # its path is known well
    of_ego = fitting_convention(sample.ego_yaw, sample.ego_motion, slow)
    fits = {name: fit for name, fit in (("yaw", of_objects), ("ego_yaw", of_ego)) if fit is not None}
    wrong = {name: fit.unit for name, fit in fits.items() if fit.sure and fit.unit in _CONVENTIONS}
    if "ego_yaw" in wrong and (sample.coordinates == "ego").any():
        wrong.pop("yaw", None)  # how objects move is not known before
    alike = len(wrong) == 2 and len(set(wrong.values())) == 1
    if alike or (wrong and np.isnan(sample.ego_yaw).all()):
        wrong = {"angle": wrong["yaw"]}
    said = next((fit.said for fit in fits.values() if fit.unit != "rad"), "")
    if wrong:
        looks = " and ".join(dict.fromkeys(_CONVENTIONS[unit][0] for unit in wrong.values()))
        whose = "headings of the vehicle look" if wrong.keys() == {"ego_yaw"} else "headings look"
        return Finding(
            "headings", f"{whose} {looks}: {said}", "expected counter-clockwise from x, rad", Mend(units=wrong)
        )
    if of_objects is None:
        return headings_in_degrees(sample.yaw)
    if not of_objects.sure:
        what = f"headings may be {_CONVENTIONS[of_objects.unit][0]}, or all turned: {said}"
        return Finding("headings", what, "expected counter-clockwise from x, rad")
    if of_objects.unit in ("world", ""):
        look = "look like those in the world, beside positions of the vehicle's frame"
        none = "fit no convention" + ", or a pose lacks of a vehicle that moves" * bool(np.isnan(sample.ego_yaw).all())
        what = f"headings {look if of_objects.unit else none}: {said}"
        expected = f"expected {'yaw - ego_yaw' if of_objects.unit else 'the direction of travel'}, or no headings"
        return Finding("headings", what, expected, Mend(columns={"yaw": ""}))
    return None


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


def frame_taken_for_another(sample: Sample) -> Finding | None:
    """Positions that are said to be in the world, and are in the vehicle's frame, or the other way round.

    Either they lie about the origin while the vehicle is far from it. Or headings or measured velocities fit how
    objects move in the other frame alone, or objects stay there where they were.
    """
    known = np.isfinite(sample.ego[1])
    given, placed, ego = sample.boxes.position[:, :2], sample.placed(), sample.ego[0]
    world, own = (np.flatnonzero(known & (sample.coordinates[sample.frame] == name)) for name in ("world", "ego"))
    if len(world) >= FEWEST:
        away = world[np.hypot(*ego[world].T) > _AWAY]
        if len(away) >= FEWEST:
            about, from_ego = (float(np.median(np.hypot(*each[away].T))) for each in (given, given - ego))
            drives = np.ptp(ego[world], axis=0).max() > _TRAVELLED
            if about < 0.5 * from_ego if drives else about < 1.5 * _AWAY and from_ego > 3 * _AWAY:
                return _EGO
        return _EGO if _fits_better(sample, world, given, placed) else None
    return _WORLD if len(own) >= FEWEST and _fits_better(sample, own, placed, given) else None


def _fits_better(sample: Sample, rows: IntArray, read: FloatArray, other: FloatArray) -> bool:
    """True if objects at `other` positions (N, 2) in the world, and not as `read`, move as one would expect."""
    turn = -sample.ego[1] if (sample.coordinates[sample.frame[rows[0]]] == "ego") else None
    motions = [sample.motion(read), sample.motion(other)]
    own = int(turn is None)  # the one of them that is of the vehicle's frame
    motions[own] = rotated(motions[own], -sample.ego[1])
    if own == 1 and _cross_traffic_fits(sample, motions, rows):
        return True
    for apart_of, least in ((_heading_apart, 0.12), (_velocity_apart, 0.3)):
        apart = [apart_of(sample, motion, rows) for motion in motions]
        decide = apart_of is _heading_apart or own == 1 or _far_from_origin(other[rows], sample.ego[0][rows])
        if decide and _less_apart(apart, least, 0.4):
            return True
        if len(apart[0]) >= 2 * FEWEST and np.median(apart[0]) < least:
            return apart_of is _velocity_apart and own == 1 and _slide_past(sample, rows)
    return own == 1 and _stay_nearer(sample, rows, read, other)  # traffic that goes along stays in the vehicle's frame


_MOVE_WITH = "positions look like coordinates of the vehicle, but are taken for the world: they move with it"
_EGO = Finding("frame", _MOVE_WITH, "expected world coordinates, or coordinates: ego", Mend(coordinates="ego"))
_STAY = "positions look like coordinates of the world, but are taken for the vehicle's: they do not move with it"
_WORLD = Finding("frame", _STAY, "expected the vehicle's frame, or coordinates: world", Mend(coordinates="world"))
_ALONG = 0.35  # rad between directions that are alike
_TRAVELLED = 3.0  # m of the vehicle, from which it shows what moves with it
_PAIRS = 20  # pairs of frames that are compared


def _cross_traffic_fits(sample: Sample, motions: Sequence[FloatArray], rows: IntArray) -> bool:
    """True if what goes across fits `motions[1]` alone: seen from the vehicle it is headed elsewhere than it moves."""
    across = rows[np.abs(np.sin(sample.yaw[rows])) > _ALONG]
    return _less_apart([_heading_apart(sample, motion, across) for motion in motions], 0.12, 0.4)


def _less_apart(apart: Sequence[FloatArray], least: float, most: float) -> bool:
    """True if the median of the first is above `least`, and that of the second low, below the share `most` of it."""
    if min(map(len, apart)) < 2 * FEWEST:
        return False
    one, another = (float(np.median(each)) for each in apart)
    return one > least and another < min(most * one, 3 * least)


def _velocity_apart(sample: Sample, motion: FloatArray, rows: IntArray) -> FloatArray:
    """m/s between measured velocities and those between frames."""
    apart = np.hypot(*(sample.boxes.velocity - motion)[rows].T)
    return np.asarray(apart[np.isfinite(apart)])


def _heading_apart(sample: Sample, motion: FloatArray, rows: IntArray) -> FloatArray:
    """Rad between headings and motion between frames, of objects that move."""
    least = np.where(sample.walks, WALKS, MOVES)
    moves = rows[(np.hypot(*motion.T) > least)[rows] & np.isfinite(sample.yaw)[rows] & ~sample.stands[rows]]
    return np.asarray(np.abs(wrap_angle(sample.yaw[moves] - np.arctan2(motion[moves, 1], motion[moves, 0]))))


_CARRIED = Finding(
    "frame",
    "positions look like coordinates of a vehicle that moves, whose pose is needed (ego_x, ego_y, ego_yaw): what they "
    "share of their motion is its",
    "expected world coordinates, or ego_x, ego_y, ego_yaw and coordinates: ego",
    Mend(coordinates="ego"),
)


def _share_motion_of_vehicle(sample: Sample) -> bool:
    """True if measured velocities, or headings of vehicles, fit motion less what most objects share, and not motion."""
    motion, velocity, time = sample.own_motion, sample.boxes.velocity, sample.time[sample.frame]
    rows = np.flatnonzero(np.isnan(sample.ego[1]) & (sample.coordinates == "world").all())
    driven = np.where(sample.walks[:, None], np.nan, motion)
    for apart_of, moved, of, least in (
        (_velocity_apart, motion, motion - velocity, MOVES),
        (_heading_apart, driven, driven, _ASTRAY),
    ):
        apart = [apart_of(sample, each, rows) for each in (moved, moved - shared_motion(time, of))]
        if _less_apart(apart, least, 0.45):
            return True
    return False


def _far_from_origin(position: FloatArray, ego: FloatArray) -> bool:
    """True if positions (n, 2) are about the vehicle at places (n, 2), and not about the origin.

    Velocities cannot tell those in the world from those of the vehicle's frame that are relative to it.
    """
    about, from_ego = (float(np.median(np.hypot(*each.T))) for each in (position, position - ego))
    return from_ego < 0.5 * about


def _slide_past(sample: Sample, rows: IntArray) -> bool:
    """True if objects move as what stands does, seen from the vehicle, and hardly any stands as it is read."""
    motion = sample.motion(sample.boxes.position[:, :2])[rows]
    driven = np.hypot(*sample.ego_motion[sample.frame[rows]].T)
    known = np.isfinite(motion).all(axis=1) & (driven > MOVES)
    motion, driven = motion[known], driven[known]
    slides = share(np.hypot(motion[:, 0] + driven, motion[:, 1]) < ALIKE)
    return len(motion) >= 2 * FEWEST and slides > 0.3 and share(np.hypot(*motion.T) < ALIKE) < 0.05


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
    with_yaw = np.isfinite(sample.yaw)
    sides = length_below_width(label[with_yaw], boxes.size[with_yaw])
    repeated = repeated_rows(sample.frame, boxes, sample.score)
    found = [scores_beyond_one(sample.score[shares]), sides, repeated, *scale]
    if any(scale):
        return [finding for finding in (*found, headings_in_degrees(sample.yaw)) if finding is not None]
    turned = headings_in_degrees(sample.ego_yaw, "ego_yaw")  # places in the world depend on it
    frame = camera_axes(boxes.position) or turned or frame_taken_for_another(sample)
    if frame is None:
        motion, measured = sample.own_motion, boxes.velocity
        of_ego, turn = sample.coordinates[sample.frame] == "ego", sample.ego[1]
        ego = sample.ego_motion[sample.frame]
        ego = np.where(of_ego[:, None], rotated(ego, -turn), ego)
        speeds = velocities_against_motion(measured, motion, ego, np.where(of_ego, -turn, turn))
        speeds = speeds or far_too_fast(label, measured)
        if speeds is None or (speeds.mend is not None and speeds.mend.units):
            known = np.isfinite(measured).any(axis=1) & (np.hypot(*measured.T) > WALKS)
            motion = np.where(known[:, None], measured, motion)
        motion = np.where(sample.stands[:, None], np.nan, motion)
        headings = headings_against_motion(sample, motion)
        named = any(each is not None and each.mend is not None and each.mend.units for each in (headings, speeds))
        carried = speeds is None and not named and _share_motion_of_vehicle(sample)
        found += [_CARRIED] if carried else [headings, speeds]
    else:
        found += [frame, headings_in_degrees(sample.yaw), far_too_fast(label, boxes.velocity)]
    return [finding for finding in found if finding is not None]
