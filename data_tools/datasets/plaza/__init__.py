"""The Plaza data sets: a lawn mower that measures its distance to radio beacons."""

from data_tools.datasets.plaza.text_files import BeaconRanges, read_plaza

__all__ = ["BeaconRanges", "read_plaza"]
