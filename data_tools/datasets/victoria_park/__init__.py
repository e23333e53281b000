"""The Victoria Park data set: a car among trees, with odometry and sightings of trees."""

from data_tools.datasets.victoria_park.text_file import TreeSightings, read_victoria_park

__all__ = ["TreeSightings", "read_victoria_park"]
