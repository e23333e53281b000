"""GTSAM factors of saga-fg: plain arrays, keys and callables in; gtsam and numpy only.

Linear families give native `gtsam.JacobianFactor`s, or many of one shape as `GaussianFactors`. Nonlinear ones give
`ResidualFactors`, which `solve` linearises together, and which `custom_factors` makes GTSAM's. What GTSAM has itself
(ranges, bearings, places, attitudes, priors) is taken from it as it is.
"""

from factors.between import ERROR_DIM, Pose, between_factor, noise_model, odometry_factors, pose, pose_prior_factor
from factors.gaussian import (
    GaussianFactors,
    check_dimensions,
    gaussian_factor,
    gaussian_factors,
    gaussian_graph,
    interaction_factor,
    interaction_factors,
    joint_prior_factor,
    marginal_factors,
    marginal_moments,
    nonlinear_graph,
    prior_factor,
    prior_factors,
)
from factors.manifolds import ImuBias, OrientedPlane, PlanarPose, SpatialPose, Variable, Vector
from factors.measurement import (
    Bearing,
    MeasurementModel,
    Polar,
    Radar,
    Range,
    RangeBearing,
    RangeRate,
    detection_factors,
)
from factors.nonlinear import ResidualFactors, residual_factor
from factors.relative import plane, plane_factor, relative_factors
from factors.robust import Mixture, Robust, RobustLoss
from factors.solver import Linearisable, Solution, SolverSettings, linearised, solve
from factors.validation import FactorError, SingularSystemError

__all__ = [
    "ERROR_DIM",
    "Bearing",
    "FactorError",
    "GaussianFactors",
    "ImuBias",
    "Linearisable",
    "MeasurementModel",
    "Mixture",
    "OrientedPlane",
    "PlanarPose",
    "Polar",
    "Pose",
    "Radar",
    "Range",
    "RangeBearing",
    "RangeRate",
    "ResidualFactors",
    "Robust",
    "RobustLoss",
    "SingularSystemError",
    "Solution",
    "SolverSettings",
    "SpatialPose",
    "Variable",
    "Vector",
    "between_factor",
    "check_dimensions",
    "detection_factors",
    "gaussian_factor",
    "gaussian_factors",
    "gaussian_graph",
    "interaction_factor",
    "interaction_factors",
    "joint_prior_factor",
    "linearised",
    "marginal_factors",
    "marginal_moments",
    "noise_model",
    "nonlinear_graph",
    "odometry_factors",
    "plane",
    "plane_factor",
    "pose",
    "pose_prior_factor",
    "prior_factor",
    "prior_factors",
    "relative_factors",
    "residual_factor",
    "solve",
]
