"""Planar laser scans: logs, registration with lines, search in a window, occupancy."""

from data_tools.laser.carmen import LaserLog, check_wheels, read_carmen, warn_of_times, without_jumps
from data_tools.laser.mapping import SMEAR, Fit, LineMap, OccupancyGrid, ScoreGrid, thinned

__all__ = [
    "SMEAR",
    "Fit",
    "LaserLog",
    "LineMap",
    "OccupancyGrid",
    "ScoreGrid",
    "check_wheels",
    "read_carmen",
    "thinned",
    "warn_of_times",
    "without_jumps",
]
