"""Planar laser scans: logs, registration with lines, search in a window, occupancy."""

from data_tools.laser.carmen import LaserLog, read_carmen
from data_tools.laser.mapping import LineMap, OccupancyGrid, ScoreGrid, thinned

__all__ = ["LaserLog", "LineMap", "OccupancyGrid", "ScoreGrid", "read_carmen", "thinned"]
