"""Trajectory and landmarks as files.

trajectory.tum, trajectory.kitti   the poses, in both formats
landmarks.json                     each landmark: number, type, coordinates (m), covariance, how often it was seen
landmarks.ply                      their places, for viewers of point clouds
above.png                          both from above
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import atomic_directory, write_bytes
from data_tools.lidar.ply import write_ply
from data_tools.plots import paths_from_above, png
from data_tools.trajectories import Trajectory, write_kitti_poses, write_tum_poses
from pipelines.figures import write_figures
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.landmark import Landmark


@dataclass(frozen=True, eq=False)
class LandmarkRecord:
    """What files say of a landmark; covariance (d, d) of its tangent."""

    number: int
    kind: str
    coordinates: dict[str, float]
    covariance: FloatArray
    observations: int

    def listed(self) -> dict[str, object]:
        """The entry of landmarks.json."""
        return {
            "number": self.number,
            "type": self.kind,
            **self.coordinates,
            "covariance": self.covariance.tolist(),
            "observations": self.observations,
        }


def records(landmarks: Sequence[Landmark]) -> list[LandmarkRecord]:
    """The landmarks of a map."""
    return [
        LandmarkRecord(l_.number, l_.kind.name, l_.kind.coordinates(l_.state), l_.covariance, l_.observations)
        for l_ in landmarks
    ]


def write_landmark_results(
    output: Path,
    trajectory: Trajectory,
    landmarks: Sequence[LandmarkRecord],
    figures: Mapping[str, object],
    others: Mapping[str, FloatArray] | None = None,
) -> None:
    """Write all files to a folder, or none.

    figures: go to figures.json; others: further paths (n, 2 or 3) for the picture, under their names.
    """
    places = np.array([[c["x"], c["y"], c.get("z", 0.0)] for c in (r.coordinates for r in landmarks)]).reshape(-1, 3)
    picture = paths_from_above({**(others or {}), "estimate": trajectory.positions}, {"landmarks": places})
    with atomic_directory(output) as folder:
        write_tum_poses(folder / "trajectory.tum", trajectory)
        write_kitti_poses(folder / "trajectory.kitti", trajectory)
        write_figures(folder / "landmarks.json", [record.listed() for record in landmarks])
        write_ply(folder / "landmarks.ply", places)
        write_figures(folder / "figures.json", dict(figures))
        write_bytes(folder / "above.png", png(picture))


def planar_trajectory(time: FloatArray, world_T_pose: FloatArray) -> Trajectory:
    """A trajectory in the plane, (N, 3, 3), as one in space at z = 0."""
    poses = np.tile(np.eye(4), (len(world_T_pose), 1, 1))
    poses[:, :2, :2] = world_T_pose[:, :2, :2]
    poses[:, :2, 3] = world_T_pose[:, :2, 2]
    return Trajectory(time, poses)
