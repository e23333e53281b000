"""GTSAM factors of saga-fg: plain arrays, keys and callables in; gtsam and numpy only.

Linear families give native `gtsam.JacobianFactor`s, which no solver needs Python for. Nonlinear ones give a
`ResidualFactor`, which `solve` linearises and `as_custom_factor` makes one of GTSAM's, or many at once, for speed, as
`ResidualFactors`. One family a file.
"""

from factors.absolute import (
    attitude_factor,
    joint_prior_factor,
    position_factor,
    prior_factor,
    prior_factors,
    stacked_prior_factors,
)
from factors.between import ERROR_DIM, Pose, between_factor, noise_model, odometry_factors, pose, pose_prior_factor
from factors.detection import (
    Camera,
    PixelBearing,
    detection_factor,
    detection_factors,
    linear_detection_factor,
    linear_detection_factors,
)
from factors.gaussian import (
    GaussianFactors,
    check_dimensions,
    gaussian_factor,
    gaussian_factors,
    gaussian_graph,
    marginal_factors,
    marginal_moments,
    nonlinear_graph,
    nonlinear_graph_at,
    stacked_gaussian_factors,
)
from factors.interaction import (
    NonlinearInteraction,
    interaction_factor,
    interaction_factors,
    stacked_interaction_factors,
)
from factors.lane import HesseLine, lane_boundary_factors, lane_keeping_factors, line_factors
from factors.manifolds import ImuBias, PlanarPose, SpatialPose, Variable, Vector
from factors.measurement import (
    Bearing,
    Components,
    MeasurementModel,
    Radar,
    Range,
    RangeBearing,
    RangeRate,
    box,
    position,
    position_velocity,
)
from factors.nonlinear import Linearisable, ResidualFactor, ResidualFactors, unwrapped_angles
from factors.plane import OrientedPlane, on_plane_factor, plane, plane_factor
from factors.relative import (
    bearing_range_factor,
    calibrated_range_factors,
    point_factors,
    range_factor,
    relative_detection_factors,
    relative_factors,
    relative_range_bearing_factors,
)
from factors.robust import Mixture, Robust, RobustLoss
from factors.solver import Solution, SolverSettings, linearised, solve
from factors.validation import FactorError, SingularSystemError

__all__ = [
    "ERROR_DIM",
    "Bearing",
    "Camera",
    "Components",
    "FactorError",
    "GaussianFactors",
    "HesseLine",
    "ImuBias",
    "Linearisable",
    "MeasurementModel",
    "Mixture",
    "NonlinearInteraction",
    "OrientedPlane",
    "PixelBearing",
    "PlanarPose",
    "Pose",
    "Radar",
    "Range",
    "RangeBearing",
    "RangeRate",
    "ResidualFactor",
    "ResidualFactors",
    "Robust",
    "RobustLoss",
    "SingularSystemError",
    "Solution",
    "SolverSettings",
    "SpatialPose",
    "Variable",
    "Vector",
    "attitude_factor",
    "bearing_range_factor",
    "between_factor",
    "box",
    "calibrated_range_factors",
    "check_dimensions",
    "detection_factor",
    "detection_factors",
    "gaussian_factor",
    "gaussian_factors",
    "gaussian_graph",
    "interaction_factor",
    "interaction_factors",
    "joint_prior_factor",
    "lane_boundary_factors",
    "lane_keeping_factors",
    "line_factors",
    "linear_detection_factor",
    "linear_detection_factors",
    "linearised",
    "marginal_factors",
    "marginal_moments",
    "noise_model",
    "nonlinear_graph",
    "nonlinear_graph_at",
    "odometry_factors",
    "on_plane_factor",
    "plane",
    "plane_factor",
    "point_factors",
    "pose",
    "pose_prior_factor",
    "position",
    "position_factor",
    "position_velocity",
    "prior_factor",
    "prior_factors",
    "range_factor",
    "relative_detection_factors",
    "relative_factors",
    "relative_range_bearing_factors",
    "solve",
    "stacked_gaussian_factors",
    "stacked_interaction_factors",
    "stacked_prior_factors",
    "unwrapped_angles",
]
