"""Results in space: boxes, tracks, covariances, edges, points, landmarks.

`ReportScene`s, scans, a SLAM result -> `Drawing`s -> a file for rerun (https://rerun.io) or Foxglove
(https://foxglove.dev), or rerun's viewer, which opens
"""

from pipelines.view.drawing import Drawing, in_order
from pipelines.view.files import check_view_file, write_view
from pipelines.view.scenes import SceneView, draw_scene
from pipelines.view.slam import SlamView, draw_slam, read_slam_view
from pipelines.view.to_rerun import load_rerun, show_rerun

__all__ = [
    "Drawing",
    "SceneView",
    "SlamView",
    "check_view_file",
    "draw_scene",
    "draw_slam",
    "in_order",
    "load_rerun",
    "read_slam_view",
    "show_rerun",
    "write_view",
]
