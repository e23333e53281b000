"""Estimators behind one base class, and the textbook reference they must agree with."""

from saga_fg.estimators.estimator import Estimator
from saga_fg.estimators.filtering import Measurements, Observations
from saga_fg.estimators.graph_filter import GraphFilter
from saga_fg.estimators.isam2_engine import RelinearisationSettings
from saga_fg.estimators.kalman import JointKalmanFilter
from saga_fg.estimators.object_factors import DetectionFactors, Interactions, NewObjects
from saga_fg.estimators.partition import BlockGaussian
from saga_fg.estimators.reference import Gaussian, kalman_predict, kalman_update, rts_smooth
from saga_fg.estimators.smoother import RecordingSmoother, SmoothedState
from saga_fg.estimators.solvers import BatchSolver, GraphSolution, IncrementalSmoother

__all__ = [
    "BatchSolver",
    "BlockGaussian",
    "DetectionFactors",
    "Estimator",
    "Gaussian",
    "GraphFilter",
    "GraphSolution",
    "IncrementalSmoother",
    "Interactions",
    "JointKalmanFilter",
    "Measurements",
    "NewObjects",
    "Observations",
    "RecordingSmoother",
    "RelinearisationSettings",
    "SmoothedState",
    "kalman_predict",
    "kalman_update",
    "rts_smooth",
]
