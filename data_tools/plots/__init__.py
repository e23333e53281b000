"""Pictures of tracks and paths, and of how good they are; matplotlib is imported when one is drawn."""

from data_tools.plots.birds_eye import Panel, birds_eye_view, png, trails
from data_tools.plots.calibration import calibration_plot
from data_tools.plots.error_histograms import error_histograms
from data_tools.plots.from_above import paths_from_above
from data_tools.plots.recall_sweep import recall_sweep
from data_tools.plots.running_graph import running_graph_picture
from data_tools.plots.scan_map import scan_map_from_above

__all__ = [
    "Panel",
    "birds_eye_view",
    "calibration_plot",
    "error_histograms",
    "paths_from_above",
    "png",
    "recall_sweep",
    "running_graph_picture",
    "scan_map_from_above",
    "trails",
]
