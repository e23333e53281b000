"""Pose graphs: the type, a start that needs no guess, their optimisation and its proof."""

from saga_fg.slam.pose_graph.certificate import ChordalMinimum, chordal_minimum
from saga_fg.slam.pose_graph.chordal import ChordalCost, chordal_poses, factorised, nearest_rotations
from saga_fg.slam.pose_graph.graph import (
    PointLandmarks,
    PoseGraph,
    PosePriors,
    PositionPriors,
    trusted,
)
from saga_fg.slam.pose_graph.optimisation import (
    SOLVER,
    Consensus,
    OptimisedPoses,
    chosen_edges,
    consensus,
    factor_graph,
    graph_error,
    graph_values,
    optimise_poses,
    pose_array,
    pose_values,
)

__all__ = [
    "SOLVER",
    "ChordalCost",
    "ChordalMinimum",
    "Consensus",
    "OptimisedPoses",
    "PointLandmarks",
    "PoseGraph",
    "PosePriors",
    "PositionPriors",
    "chordal_minimum",
    "chordal_poses",
    "chosen_edges",
    "consensus",
    "factor_graph",
    "factorised",
    "graph_error",
    "graph_values",
    "nearest_rotations",
    "optimise_poses",
    "pose_array",
    "pose_values",
    "trusted",
]
