"""Pose graphs: the type, a start that needs no guess, and their optimisation."""

from saga_fg.slam.pose_graph.chordal import chordal_poses, nearest_rotations
from saga_fg.slam.pose_graph.graph import PoseGraph
from saga_fg.slam.pose_graph.optimisation import OptimisedPoses, factor_graph, optimise_poses, pose_array, pose_values

__all__ = [
    "OptimisedPoses",
    "PoseGraph",
    "chordal_poses",
    "factor_graph",
    "nearest_rotations",
    "optimise_poses",
    "pose_array",
    "pose_values",
]
