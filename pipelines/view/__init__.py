"""Results in space: boxes, tracks, covariances, edges, points, landmarks.

`ReportScene`s, scans, a SLAM result -> `Drawing`s -> a file for Foxglove (https://foxglove.dev)
"""

from pipelines.view.scenes import (
    Drawing,
    SceneView,
    SlamView,
    draw_scene,
    draw_slam,
    in_order,
    read_slam_view,
    result_views,
)
from pipelines.view.writers import check_view_file, write_view

__all__ = [
    "Drawing",
    "SceneView",
    "SlamView",
    "check_view_file",
    "draw_scene",
    "draw_slam",
    "in_order",
    "read_slam_view",
    "result_views",
    "write_view",
]
