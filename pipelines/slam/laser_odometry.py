"""Odometry, keyframes and loops of a robot with a planar laser.

Odometry of a robot with a planar laser, without implausible steps, and the scale of the wheels.

Along a bare corridor odometry alone tells the way, and wheels of another size than the robot believes err by some per
cent. The scale k is estimated from the steps s that registration determines, as x ahead:

    s_registered = k s_wheels + noise of variance v,        k ~ N(1, 0.05^2)

Loops of a planar laser: keyframes are searched for in older submaps, by branch and bound.

The window is what the graph leaves open: it grows with the way along measurements between the two, so that what has
been closed before is searched closely and what has drifted widely. A place that has a rival is no loop; one found in a
wide window waits for another that agrees with it. Along a bare corridor a scan tells no place.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from data_tools.laser import LaserLog
from data_tools.laser.mapping import SMEAR, Fit, LineMap, ScoreGrid, thinned
from pipelines.slam.loop_closures import Agreement
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import moved, transform, transforms, vector, vectors
from saga_fg.slam.pose_graph.consensus import Measured, RunningPoseGraph

_SLACK = 1.0  # m that a step of the wheels may be longer than the largest speed allows: logs come in bursts
_SCALE = 0.05  # standard deviation of the scale of wheels
_STEP_NOISE = 0.02  # m, of a step that registration determines: it errs with the map
_KNOWN_SCALE = 0.005  # standard deviation at which the scale is as good as known
_BELIEVED = 0.3  # share of a step by which registration may differ: beyond, wheels slipped, or it erred
_STILL, _CHANGED, _MANY = 1e-6, 0.3, 0.3  # m of the wheels; m of a reading, and the share of a scan, that show motion
_log = logging.getLogger(__name__)


def without_jumps(log: LaserLog, largest_speed: float) -> tuple[FloatArray, int]:
    """Poses (n, 3) of the wheels, where steps faster than `largest_speed` (m/s) count as standing still; their number.

    Steps may be 1 m longer than that speed allows. Warns of the first one.
    """
    wheels = transforms(log.odometry)
    step = np.linalg.inv(wheels[:-1]) @ wheels[1:]
    way, seconds = np.hypot(step[:, 0, 2], step[:, 1, 2]), np.maximum(np.diff(log.time), 0.0)
    jumps = np.flatnonzero(way > largest_speed * seconds + _SLACK)
    if not len(jumps):
        return log.odometry, 0
    first = int(jumps[0])
    _log.warning(
        "scan %d: the wheels moved %.3g m in %.3g s, more than largest_speed, %g m/s, allows; "
        "so in %d steps, which count as standing still",
        first + 2, way[first], seconds[first], largest_speed, len(jumps),
    )  # fmt: skip
    for row in jumps.tolist():  # what follows moves by what the jump did
        wheels[row + 1 :] = wheels[row] @ np.linalg.inv(wheels[row + 1]) @ wheels[row + 1 :]
    return vectors(wheels), len(jumps)


def warn_of_times(time: FloatArray) -> None:
    """Warns where times (n,), s, run backwards, as those of logs that are written by several processes do, or stay."""
    same = np.flatnonzero(np.diff(time) == 0)
    if len(same):
        _log.warning(
            "scan %d: its time is that of the scan ahead of it; so for %d of %d scans, "
            "of which the files have the pose of the first at each time",
            int(same[0]) + 2, len(same), len(time),
        )  # fmt: skip
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        _log.warning(
            "scan %d: its time is %.3g s before that of the scan ahead of it; so for %d of %d scans, "
            "which are taken in the order of the log, with poses written in the order of time",
            int(back[0]) + 2, time[back[0]] - time[back[0] + 1], len(back), len(time),
        )  # fmt: skip


def check_wheels(log: LaserLog) -> None:
    """Raise `InputError` where the wheels say one pose throughout while what the laser sees changes."""
    if len(log) < 2 or np.ptp(log.odometry, axis=0).max() > _STILL:
        return
    alike = np.broadcast_to(np.isclose(log.angles, log.directions(0)), log.ranges.shape)  # not so of interlaced lasers
    changed = (alike & (np.abs(log.ranges - log.ranges[0]) > _CHANGED)).sum(axis=1) / np.maximum(alike.sum(axis=1), 1)
    if (moved := int(np.argmax(changed > _MANY))) > 0:
        raise InputError(
            f"scan {moved + 1}: {100 * changed[moved]:.0f} % of the readings differ from those of the first scan, but "
            "the wheels stand still throughout: expected odometry"
        )


@dataclass(eq=False)
class WheelScale:
    """Ratio of ways driven to those that the wheels tell, from steps that registration determines."""

    _information: float = _SCALE**-2
    _weighted: float = _SCALE**-2

    @property
    def value(self) -> float:
        """The estimate of k."""
        return self._weighted / self._information

    @property
    def known(self) -> bool:
        """True if more steps hardly change it."""
        return self._information > _KNOWN_SCALE**-2

    def corrected(self, step: FloatArray) -> FloatArray:
        """A step (3, 3) of the wheels in true metres."""
        scaled = step.copy()
        scaled[:2, 2] *= self.value
        return scaled

    def update(self, predicted: FloatArray, registered: FloatArray, covariance: FloatArray) -> None:
        """Take a corrected step of the wheels and that by registration (3, 3), with the covariance of the latter."""
        wheels, driven = float(predicted[0, 2]) / self.value, float(registered[0, 2])
        if abs(driven - predicted[0, 2]) > _BELIEVED * abs(predicted[0, 2]):
            return
        weight = 1 / (float(covariance[0, 0]) + _STEP_NOISE**2)
        self._information += weight * wheels**2
        self._weighted += weight * wheels * driven


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


_KNOWN_SHARE = 0.8  # m, half width of a window up to which a corridor may be recognised: it then says nothing along it
_UNSURE = 1.5  # m, half width from which a loop waits for another that agrees with it
_ACROSS = 5.0  # m from the centre of a submap that it is searched from, besides the window
_UNIQUE = 0.92  # share of the best score that a rival may have
_LONGEST = 60.0  # m of way from which the search of headings does not grow


@dataclass(frozen=True, eq=False)
class _Submap:
    """Keyframes from `first` to before `end`, in the frame of `centre`."""

    first: int
    end: int
    centre: int
    grid: ScoreGrid
    lines: LineMap


def _agreement() -> Agreement[Measured]:
    return Agreement(np.array([0.3, 0.06]), np.array([0.03, 0.003]), patience=15.0)


@dataclass(eq=False)
class LoopSearch:
    """Submaps of a growing list of keyframes, and the search in them.

    length  m of way in a submap; drift: half width of the window, share of the way; score: least mean score of a loop
    """

    keyframes: Sequence[Keyframe]
    graph: RunningPoseGraph
    length: float
    drift: float
    score: float
    _submaps: list[_Submap] = field(default_factory=list)
    _agreement: Agreement[Measured] = field(default_factory=_agreement)

    def extend(self) -> None:
        """Close a submap if the keyframes since the last one go far enough."""
        frames = self.keyframes
        first = self._submaps[-1].end if self._submaps else 0
        if frames[-1].way - frames[first].way > self.length:
            centre = (first + len(frames)) // 2
            points = joined(frames[first:], frames[centre])
            self._submaps.append(_Submap(first, len(frames), centre, ScoreGrid.of(points), LineMap.of(points)))

    def loops(self, row: int) -> list[Measured]:
        """Loops of a keyframe to the nearest older submaps whose windows reach it, and those that they confirm."""
        frames = self.keyframes
        over = [each for each in self._submaps if frames[each.end - 1].way < frames[row].way - self.length]
        if not over:
            return []
        centres = np.array([each.centre for each in over])
        way = self.graph.distances(row)[centres]
        poses = self.graph.poses
        window = 0.5 + self.drift * way
        apart = np.linalg.norm(poses[centres, :2, 2] - poses[row, :2, 2], axis=1)
        near = np.flatnonzero(apart < _ACROSS + window)
        near = near[np.argsort(apart[near])]
        source = self._source(row)
        found: list[Measured] = []
        for at in near[: 3 + int(window[near].min(initial=0.0))].tolist():
            guess = np.linalg.inv(poses[centres[at]]) @ poses[row]
            turn = np.deg2rad(5) + 0.01 * min(way[at], _LONGEST)
            loop = self._loop(over[at], row, source, guess, float(window[at]), float(turn))
            if loop is not None:
                found += [loop] if window[at] < _UNSURE else self._confirmed(loop)
                if len(found) >= 2:
                    break
        return found

    def _confirmed(self, loop: Measured) -> Sequence[Measured]:
        frames = self.keyframes
        return self._agreement.confirmed(
            loop,
            lambda one, other: np.asarray(np.linalg.inv(frames[one].matched) @ frames[other].matched),
            lambda row: frames[row].way,
        )

    def _loop(
        self, submap: _Submap, row: int, source: FloatArray, guess: FloatArray, window: float, turn: float
    ) -> Measured | None:
        found = submap.grid.search(source, vector(guess), window, turn, self.score)
        if found is None or found.rival > _UNIQUE * found.score:
            return None
        fit = submap.lines.fit(self.keyframes[row].points, found.pose, np.diag([1.0, 1.0, 10.0]), reach=0.4)
        if fit.share < self.score or (window > _KNOWN_SHARE and not determined(fit.information)):
            return None
        return measured_by(submap.centre, row, fit)

    def _source(self, row: int) -> FloatArray:
        """Points of a keyframe and of the four before it, in its frame."""
        frames = self.keyframes[max(0, row - 4) : row + 1]
        return thinned(joined(frames, frames[-1]), 0.2)
