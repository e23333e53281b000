"""Estimators behind one protocol, and the textbook reference they must agree with."""

from saga_fg.estimators.kalman import JointKalmanFilter
from saga_fg.estimators.protocol import Estimator, Measurements
from saga_fg.estimators.reference import Gaussian, kalman_predict, kalman_update, rts_smooth

__all__ = [
    "Estimator",
    "Gaussian",
    "JointKalmanFilter",
    "Measurements",
    "kalman_predict",
    "kalman_update",
    "rts_smooth",
]
