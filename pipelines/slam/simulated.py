"""SLAM on a simulated street, where the truth is known: results as files.

odometry.tum, joint.tum, truth.tum   the paths (TUM); joint.txt the estimated one in KITTI's format
online.tum, settled.tum              if estimated online as well: each pose as known at once, and a lag later
covariances.csv                      of each estimated pose in its own frame: rotation vector (rad), translation (m)
tracks.csv                           objects in the world at every moment: place, velocity and their deviations
landmarks.json                       those that detectors of the configuration found: kind, place, covariance
errors.json                          ATE and relative error of the odometry's path and of the estimated one
above.png                            the paths and the objects from above
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.figures import write_figures
from data_tools.files.atomic_files import atomic_directory, write_bytes, write_text
from data_tools.plots import paths_from_above, png
from data_tools.simulator import SimulatorSettings
from data_tools.simulator.settings import LightSettings, SurroundingSettings
from data_tools.trajectories import Trajectory, trajectory_errors, write_kitti_poses, write_tum_poses
from pipelines.slam.joint import JointRun
from pipelines.slam.landmark_results import records
from pipelines.slam.object_tracks import tracks, tracks_csv


def street(parked: bool = True, mapped: bool = False) -> SimulatorSettings:
    """Simulated scenes with cars parked on both sides of the road, or on none; mapped: frames bring the lanes along."""
    surroundings = SurroundingSettings(parking_probability=1.0 if parked else 0.0)
    return SimulatorSettings(surroundings=surroundings, lights=LightSettings(mapped=mapped))


def write_joint(output: Path, run: JointRun) -> None:
    """Write the results of one scene to a folder, all or none of them."""
    odometry, joint = run.errors()
    with atomic_directory(output) as folder:
        write_tum_poses(folder / "truth.tum", run.truth)
        write_tum_poses(folder / "odometry.tum", run.odometry)
        write_tum_poses(folder / "joint.tum", run.joint)
        write_kitti_poses(folder / "joint.txt", run.joint, folder / "times.txt")
        for name, path in online_paths(run).items():
            write_tum_poses(folder / f"{name}.tum", path)
        write_text(folder / "covariances.csv", _covariances(run))
        write_text(folder / "tracks.csv", tracks_csv(run.estimate))
        errors = {"odometry": asdict(odometry), "joint": asdict(joint)}
        errors |= {name: asdict(trajectory_errors(path, run.truth)) for name, path in online_paths(run).items()}
        write_figures(folder / "errors.json", errors)
        write_figures(folder / "landmarks.json", [record.listed() for record in records(run.estimate.landmarks)])
        write_bytes(folder / "above.png", png(picture(run)))


def online_paths(run: JointRun) -> dict[str, Trajectory]:
    """The online estimate's path, each pose as known at once and as settled; empty without one."""
    if run.online is None:
        return {}
    times = run.online.timestamps
    return {"online": Trajectory(times, run.online.newest), "settled": Trajectory(times, run.online.settled)}


def picture(run: JointRun) -> Any:
    """The paths from above, and where objects were last seen."""
    paths = {"truth": run.truth.positions, "odometry": run.odometry.positions, "joint": run.joint.positions}
    paths |= {name: path.positions for name, path in online_paths(run).items() if name == "online"}
    last = np.array([track[-1] for track in tracks(run.estimate).values()]).reshape(-1, 2)
    return paths_from_above(paths, {"objects": last})


def _covariances(run: JointRun) -> str:
    upper = np.triu_indices(6)
    rows = [",".join(["timestamp", *(f"P{i + 1}{j + 1}" for i, j in zip(*upper, strict=True))])]
    for time, P in zip(run.estimate.timestamps.tolist(), run.estimate.pose_covariances, strict=True):
        rows.append(",".join([f"{time:.6f}", *(f"{x:.6g}" for x in P[upper])]))
    return "\n".join(rows) + "\n"
