"""GTSAM factors of saga-fg: plain arrays, keys and callables in; gtsam and numpy only.

Linear families give native `gtsam.JacobianFactor`s.
"""

from factors.errors import FactorError, SingularSystemError
from factors.gaussian import gaussian_factor, gaussian_graph, nonlinear_graph, nonlinear_graph_at
from factors.interaction import interaction_factor, interaction_factors
from factors.marginal import marginal_factors, marginal_moments
from factors.prior import joint_prior_factor, prior_factor

__all__ = [
    "FactorError",
    "SingularSystemError",
    "gaussian_factor",
    "gaussian_graph",
    "interaction_factor",
    "interaction_factors",
    "joint_prior_factor",
    "marginal_factors",
    "marginal_moments",
    "nonlinear_graph",
    "nonlinear_graph_at",
    "prior_factor",
]
