"""Pose graphs in files."""

from data_tools.pose_graphs.g2o import read_g2o, write_g2o

__all__ = ["read_g2o", "write_g2o"]
