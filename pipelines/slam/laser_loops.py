"""Loops of a planar laser: keyframes are searched for in older submaps, by branch and bound.

The window is what the graph leaves open: it grows with the way along measurements between the two, so that what has
been closed before is searched closely and what has drifted widely. A place that has a rival is no loop; one found in a
wide window waits for another that agrees with it. Along a bare corridor a scan tells no place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from data_tools.laser.line_map import LineMap, thinned
from data_tools.laser.score_grid import ScoreGrid
from pipelines.slam.laser_keyframes import Keyframe, determined, joined, measured_by
from pipelines.slam.loop_agreement import Agreement
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import vector
from saga_fg.slam.pose_graph.running import Measured, RunningPoseGraph

_KNOWN = 0.8  # m, half width of a window up to which a corridor may be recognised: it then says nothing along it
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
        if fit.share < self.score or (window > _KNOWN and not determined(fit.information)):
            return None
        return measured_by(submap.centre, row, fit)

    def _source(self, row: int) -> FloatArray:
        """Points of a keyframe and of the four before it, in its frame."""
        frames = self.keyframes[max(0, row - 4) : row + 1]
        return thinned(joined(frames, frames[-1]), 0.2)
