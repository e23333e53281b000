"""Pictures of tracks and paths; matplotlib is imported when one is drawn."""

from data_tools.plots.birds_eye import Panel, birds_eye_view, png, trails
from data_tools.plots.from_above import paths_from_above

__all__ = ["Panel", "birds_eye_view", "paths_from_above", "png", "trails"]
