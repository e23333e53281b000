"""Pose graphs in files, and generated ones."""

from data_tools.pose_graphs.g2o import read_g2o, write_g2o
from data_tools.pose_graphs.generated import city, cube, grid, sphere, torus

__all__ = ["city", "cube", "grid", "read_g2o", "sphere", "torus", "write_g2o"]
