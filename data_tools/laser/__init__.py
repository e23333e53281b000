"""Planar laser scans: logs, registration with lines, search in a window, occupancy."""

from data_tools.laser.carmen import LaserLog, read_carmen
from data_tools.laser.line_map import LineMap, thinned
from data_tools.laser.occupancy import OccupancyGrid
from data_tools.laser.score_grid import ScoreGrid

__all__ = ["LaserLog", "LineMap", "OccupancyGrid", "ScoreGrid", "read_carmen", "thinned"]
