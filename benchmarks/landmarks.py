"""SLAM on drives past landmarks: trees of unknown identity (Victoria Park), and ranges to beacons (Plaza).

The covariances of a recording's odometry assume independent errors. True errors persist (a wheel slips through the
whole bend), and add up to more. So a scale of the covariances is chosen first for a drive past trees, the likeliest of
a few on the beginning (`LandmarkMapper.log_evidence`); the identities in the file are not used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.agreement import pairwise_agreement
from benchmarks.landmark_mapper import LandmarkMapper, MapperSettings
from benchmarks.recordings.landmarks import LandmarkLog, read_landmark_log
from benchmarks.recordings.ranges import compared, map_beacons
from benchmarks.runner import Rows, each
from data_tools.figures import paths_from_above, png, write_figures
from data_tools.files import atomic_directory, check_writable_folder, write_bytes
from data_tools.trajectories import Trajectory, write_kitti_poses, write_tum_poses
from pipelines.slam.results import landmark_row, landmark_rows, planar_trajectory
from saga_fg.errors import InputError
from saga_fg.model import PointLandmark
from saga_fg.numerics import FloatArray
from saga_fg.types import Observation

SCALES = (1.0, 4.0, 16.0, 64.0, 256.0)  # of the covariance, to choose of
BEGINNING = 2000  # poses on which that is chosen
TREE = PointLandmark(name="tree", density=0.01)  # one on 10 m by 10 m
MAPPER = MapperSettings(smooth_every=300)
_START = 1e-6  # variance of the first pose, m^2 and rad^2

_Found = tuple[FloatArray, list[dict[str, Any]], dict[str, Any], dict[str, FloatArray]]
"""world_T_pose (N, 3, 3), rows of landmarks.json, figures, and further paths for the picture."""


def landmarks(
    file: Annotated[Path, typer.Argument(help="victoria_park.txt, or NAME_DR.txt of Plaza with the others beside it.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for trajectory, landmarks, figures and a picture.")
    ] = None,
    odometry_scale: Annotated[
        float | None,
        typer.Option("--odometry-scale", help="Of the covariance of Victoria Park; chosen from data if left out."),
    ] = None,
) -> Rows:
    """Map a drive past landmarks: trees without the identities in the file, beacons by ranges of a radio alone.

    Trees are compared with these identities, beacons and the drive with the truth where there is one.

    \b
    Examples:
      python -m benchmarks landmarks data/slam/victoria_park.txt --output park
      python -m benchmarks landmarks data/slam/Plaza2_DR.txt --output plaza2
    """
    if odometry_scale is not None and not 0 < odometry_scale < np.inf:
        raise InputError(f"--odometry-scale {odometry_scale:g}: expected a number > 0")
    if output is not None:
        check_writable_folder(output)
    drive = read_landmark_log(file)
    ranges = drive.value.shape[1] == 1
    if ranges and odometry_scale is not None:
        raise InputError(f"--odometry-scale: expected a drive past trees, {file} has ranges")
    poses, rows, figures, paths = _beacons(drive) if ranges else _park(drive, odometry_scale)
    if output is not None:
        write_landmark_map(output, planar_trajectory(drive.time, poses), rows, figures, paths)
    yield f"{file.name}: {len(poses)} poses, {len(drive.value)} observations, {len(rows)} landmarks", figures


def _beacons(drive: LandmarkLog) -> _Found:
    found = map_beacons(drive)
    rows = []
    for number, (x, y) in found.beacons.items():
        seen = int((drive.landmark == number).sum())
        rows.append(landmark_row(number, "beacon", {"x": float(x), "y": float(y)}, found.covariances[number], seen))
    return found.world_T_pose, rows, *compared(drive, found)


def _park(drive: LandmarkLog, scale: float | None) -> _Found:
    scales = SCALES if scale is None else (scale,)
    tried = {one: _driven(drive, one, BEGINNING).log_evidence() for one in scales} if scale is None else {}
    chosen = max(scales, key=lambda one: tried.get(one, 0.0))
    park = _driven(drive, chosen).map()
    agreement = pairwise_agreement([one.landmark for one in park.observations], drive.landmark)
    counts = {"poses": len(drive.time), "observations": len(drive.landmark), "landmarks": len(park.landmarks)}
    named = {"landmarks named in the file": len(np.unique(drive.landmark))}
    pairs = {
        "pairwise precision": agreement.precision,
        "pairwise recall": agreement.recall,
        "pairwise F1": agreement.f1,
        "odometry scale": chosen,
        "log evidence by odometry scale": {f"{one:g}": value for one, value in tried.items()},
    }
    return park.world_T_pose, landmark_rows(park.landmarks), {**counts, **named, **pairs}, {}


def write_landmark_map(
    output: Path,
    trajectory: Trajectory,
    landmarks: Sequence[Mapping[str, Any]],
    figures: Mapping[str, object],
    others: Mapping[str, FloatArray] | None = None,
) -> None:
    """Write trajectory.tum, trajectory.kitti, landmarks.json, figures.json and above.png.

    landmarks: rows of landmarks.json; others: further paths (n, 2 or 3) for the picture, by name
    """
    places = np.array([[row["x"], row["y"], row.get("z", 0.0)] for row in landmarks]).reshape(-1, 3)
    picture = paths_from_above({**(others or {}), "estimate": trajectory.positions}, {"landmarks": places})
    with atomic_directory(output) as folder:
        write_tum_poses(folder / "trajectory.tum", trajectory)
        write_kitti_poses(folder / "trajectory.kitti", trajectory)
        write_figures(folder / "landmarks.json", landmarks)
        write_figures(folder / "figures.json", dict(figures))
        write_bytes(folder / "above.png", png(picture))


def _driven(drive: LandmarkLog, scale: float, most: int | None = None) -> LandmarkMapper:
    """The mapper after the first poses, or all of them."""
    mapper = LandmarkMapper(np.eye(3), _START * np.eye(3), MAPPER)
    begin = np.searchsorted(drive.pose, np.arange(len(drive.time) + 1)).tolist()
    for pose in each(range(len(drive.time))[:most], f"odometry covariance x {scale:g}"):
        if pose:
            mapper.move(drive.a_T_b[pose - 1], scale * drive.odometry_covariance[pose - 1])
        rows = range(begin[pose], begin[pose + 1])
        mapper.observe([Observation(TREE, drive.value[row], drive.covariance[row]) for row in rows])
    return mapper
