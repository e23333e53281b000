"""Results in space, in the viewer rerun (https://rerun.io): boxes, tracks, covariances, edges, points, landmarks.

`ReportScene`s, scans, a SLAM result -> `write_view` -> a file .rrd, or a viewer that opens
"""

from pipelines.view.scenes import SceneView, log_scene
from pipelines.view.slam import SlamView, log_slam, read_slam_view
from pipelines.view.stream import load_rerun, show_view, write_view

__all__ = [
    "SceneView",
    "SlamView",
    "load_rerun",
    "log_scene",
    "log_slam",
    "read_slam_view",
    "show_view",
    "write_view",
]
