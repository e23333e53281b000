"""Tracking without a detector: clusters of LiDAR points as the detections of a scene."""

from __future__ import annotations

import numpy as np

from data_tools.lidar import ClusterSettings, detect_clusters
from data_tools.lidar.scan import ScanSequence
from pipelines.tracking import Progress
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame


def cluster_scene(
    name: str,
    scans: ScanSequence,
    world_T_ego: FloatArray | None = None,
    ground_truth: list[Annotations] | None = None,
    settings: ClusterSettings | None = None,
    progress: Progress | None = None,
) -> Scene:
    """A scene with a frame of clusters for each scan, in world coordinates, sensor "lidar".

    world_T_ego   (K, 4, 4) poses at the scans, for instance of LiDAR odometry; None for the recording's own
    ground_truth  K annotations to keep with it
    """
    poses = scans.world_T_ego if world_T_ego is None else world_T_ego
    frames = []
    for k, timestamp in enumerate(scans.timestamps.tolist()):
        found = detect_clusters(scans[k].points, settings).transformed(poses[k] @ scans.ego_T_lidar)
        frames.append(Frame(timestamp, "lidar", found, poses[k]))
        if progress is not None:
            progress(name, k + 1, len(scans))
    return Scene(name, scans.timestamps, np.asarray(poses), ("",) * len(scans), frames, ground_truth)
