"""Results in space: boxes, tracks, covariances, edges, points, landmarks.

`ReportScene`s, scans, a SLAM result -> `Drawing`s -> a file for rerun (https://rerun.io) or Foxglove
(https://foxglove.dev), or rerun's viewer, which opens
"""

from pipelines.view.scenes import (
    Drawing,
    SceneView,
    SlamView,
    draw_scene,
    draw_slam,
    draw_slam_step,
    in_order,
    read_slam_view,
    result_views,
)
from pipelines.view.writers import RerunViewer, check_view_file, load_rerun, write_view

__all__ = [
    "Drawing",
    "RerunViewer",
    "SceneView",
    "SlamView",
    "check_view_file",
    "draw_scene",
    "draw_slam",
    "draw_slam_step",
    "in_order",
    "load_rerun",
    "read_slam_view",
    "result_views",
    "write_view",
]
