"""Pictures of tracks; matplotlib is imported when one is drawn."""

from data_tools.plots.birds_eye import Panel, birds_eye_view, png, trails

__all__ = ["Panel", "birds_eye_view", "png", "trails"]
