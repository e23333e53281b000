"""Pictures of tracks, paths, graphs and metrics; matplotlib is imported when one is drawn."""

from data_tools.plots.birds_eye import (
    occupancy_picture,
    paths_from_above,
    plot,
    png,
    scan_map_from_above,
)
from data_tools.plots.metrics import calibration_plot, error_histograms, recall_sweep
from data_tools.plots.running_graph import running_graph_picture

__all__ = [
    "calibration_plot",
    "error_histograms",
    "occupancy_picture",
    "paths_from_above",
    "plot",
    "png",
    "recall_sweep",
    "running_graph_picture",
    "scan_map_from_above",
]
