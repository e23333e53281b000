"""Cost of `LandmarkMapper` while its map grows: a pose at the end of a drive beside one at its beginning, in one run.

The vehicle drives up and down a field of landmarks, line beside line, so that it always sees those of the line before
again; which one is which it is not told. Times are CPU times of the process, on one thread.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy.spatial import cKDTree

from data_tools.metrics.pairwise_agreement import pairwise_agreement
from pipelines.process import one_thread, peak_memory
from pipelines.tracking import Progress
from saga_fg.model.landmarks.point import PointLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LandmarkMapper
from saga_fg.types.landmark import Observation

_APART, _LINES, _WIDTH = 10.0, 20.0, 200.0  # m between landmarks, between lines, and of the field
_STEP, _REACH = 2.0, 20.0  # m
_MOTION, _NOISE = np.array([0.03, 0.02, 0.002]), 0.1  # standard deviations of a motion (m, m, rad) and of places, m
_START = 1e-6


@dataclass(frozen=True)
class MapPart:
    """Poses `first` to `last`: milliseconds a pose, landmarks of the map at the end, and of these in the Gaussian."""

    first: int
    last: int
    pose: float
    landmarks: int
    local: int


@dataclass(frozen=True)
class MapCost:
    """A drive past so many landmarks, in tenths.

    ratio    of milliseconds a pose, the last tenth to the second one: at the start no line has another beside it
    growth   of the map between these two tenths
    f1       over pairs of observations, of the landmarks found against the true ones
    error    m, RMS distance of poses from the truth; memory: MB, largest of the process
    """

    poses: int
    observations: int
    landmarks: int
    parts: list[MapPart]
    ratio: float
    growth: float
    f1: float
    error: float
    memory: float


def bench_landmarks(landmarks: int, seed: int = 0, progress: Progress | None = None) -> MapCost:
    """Drive and measure."""
    rng = np.random.default_rng(seed)
    across = int(_WIDTH / _APART)
    grid = np.stack([np.arange(landmarks) % across, np.arange(landmarks) // across], axis=1)
    places = _APART * grid + rng.uniform(-3.0, 3.0, (landmarks, 2))
    poses = _lines(_APART * float(grid[:, 1].max()))
    tree, kind, Q = cKDTree(places), PointLandmark(density=1 / _APART**2), np.diag(_MOTION**2)
    mapper, cost = LandmarkMapper(poses[0].matrix(), _START * np.eye(3)), np.zeros(len(poses))
    found: list[tuple[int, int]] = []
    true: list[int] = []
    with one_thread():
        for k, pose in enumerate(poses):
            near = np.sort(np.array(tree.query_ball_point(pose.translation(), _REACH), dtype=np.int64))
            seen = [pose.transformTo(places[n]) for n in near]
            ahead = [row for row, place in enumerate(seen) if place[0] > 0]
            R = _NOISE**2 * np.eye(2)
            observations = [Observation(kind, seen[row] + _NOISE * rng.normal(size=2), R) for row in ahead]
            motion = None if k == 0 else poses[k - 1].between(pose).retract(_MOTION * rng.normal(size=3)).matrix()
            began = time.process_time()
            if motion is not None:
                mapper.move(motion, Q)
            mapper.observe(observations)
            cost[k] = time.process_time() - began
            true += near[ahead].tolist()
            found.append((len(mapper.landmarks), len(mapper.local.kinds)))
            if progress is not None:
                progress("drive", k + 1, len(poses))
        done = mapper.map()
    edges = np.linspace(0, len(poses), 11).astype(int).tolist()
    parts = [MapPart(a, b, 1e3 * float(cost[a:b].mean()), *found[b - 1]) for a, b in pairwise(edges)]
    off = done.world_T_pose[:, :2, 2] - np.array([pose.translation() for pose in poses])
    return MapCost(
        poses=len(poses),
        observations=len(true),
        landmarks=len(done.landmarks),
        parts=parts,
        ratio=parts[-1].pose / parts[1].pose,
        growth=parts[-1].landmarks / parts[1].landmarks,
        f1=pairwise_agreement([one.landmark for one in done.observations], true).f1,
        error=float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
        memory=peak_memory(),
    )


def _lines(length: float) -> list[gtsam.Pose2]:
    """Poses along lines across the field, up and down, over its length."""
    corners: list[FloatArray] = []
    for line in range(int(length / _LINES) + 1):
        ends = np.array([[0.0, _WIDTH][:: 1 if line % 2 == 0 else -1], [line * _LINES] * 2]).T
        corners += list(ends)
    poses = []
    for a, b in pairwise(corners):
        count = max(1, round(float(np.linalg.norm(b - a)) / _STEP))
        heading = float(np.arctan2(*(b - a)[::-1]))
        poses += [gtsam.Pose2(heading, a + (b - a) * k / count) for k in range(count)]
    return poses
