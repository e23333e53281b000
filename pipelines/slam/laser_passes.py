"""Registration of passes of one place with each other."""

from __future__ import annotations

import numpy as np

from data_tools.laser.line_map import LineMap
from pipelines.slam.laser_keyframes import Keyframe, joined, measured_by
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import vector
from saga_fg.slam.pose_graph.running import Measured

_NEARBY = 3.0  # m between keyframes that see the same walls
_GAP = 5.0  # m of way without a keyframe nearby, from which on it is another pass
_SHARED = 3  # keyframes in a row that share a map
_MOST_PASSES = 4  # that a keyframe is registered with
_PRIOR = np.diag([100.0, 100.0, 1000.0])  # information of the graph about where the other pass is


def registered_passes(
    frames: list[Keyframe], poses: FloatArray, reach: float, local_map: float, least_share: float
) -> list[Measured]:
    """Registrations of each keyframe with the map of every other pass nearby, of points within `reach`, m.

    poses (n, 3, 3) of the keyframes; local_map: m of way; least_share: of the points that must lie on the map.
    """
    found: list[Measured] = []
    maps: dict[int, LineMap] = {}
    places = poses[:, :2, 2]
    way = np.array([frame.way for frame in frames])
    for row in range(len(poses)):
        apart = np.linalg.norm(places[:row] - places[row], axis=1)
        others = np.flatnonzero((apart < _NEARBY) & (way[:row] < way[row] - 2 * local_map))
        if not len(others):
            continue
        runs = np.split(others, np.flatnonzero(np.diff(way[others]) > _GAP) + 1)
        nearest = sorted((int(run[np.argmin(apart[run])]) for run in runs), key=lambda k: apart[k])
        for other in dict.fromkeys(near // _SHARED * _SHARED for near in nearest[:_MOST_PASSES]):
            if other not in maps:
                around = [frame for frame in frames if abs(frame.way - way[other]) < local_map / 3]
                maps[other] = LineMap.of(joined(around, frames[other]))
            guess = np.linalg.inv(poses[other]) @ poses[row]
            fit = maps[other].fit(frames[row].points, vector(guess), _PRIOR, reach)
            if fit.share > least_share:
                found.append(measured_by(other, row, fit))
    return found
