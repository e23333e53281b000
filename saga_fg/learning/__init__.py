"""Learn from recordings: noise, scores and detection probability of sensors, process noise, and interactions."""

from saga_fg.learning.hidden_objects import GapPrediction, HiddenObjects, hidden_objects
from saga_fg.learning.interaction_fit import (
    MAX_GAPS,
    TEMPLATE,
    FittedInteractions,
    Rule,
    fit_interactions,
    negative_log_likelihood,
)
from saga_fg.learning.labelled_scene import (
    GATE,
    DetectionSample,
    MatchedFrame,
    SampledDetections,
    SampledObjects,
    match_to_truth,
    measured_trajectories,
    sample_with_truth,
)
from saga_fg.learning.process_noise import (
    MeasuredTrajectory,
    fit_acceleration_noise,
    fit_acceleration_noise_by_class,
    fit_curvilinear,
    fit_curvilinear_by_class,
)
from saga_fg.learning.sensor_fit import (
    fit_position_noise,
    fit_score_calibration,
    fit_sensor,
    learn_confusion,
    learn_sizes,
)
from saga_fg.learning.trajectory_noise import DetectedTrajectory, fit_trajectory_noise, sample_with_tracker

__all__ = [
    "GATE",
    "MAX_GAPS",
    "TEMPLATE",
    "DetectedTrajectory",
    "DetectionSample",
    "FittedInteractions",
    "GapPrediction",
    "HiddenObjects",
    "MatchedFrame",
    "MeasuredTrajectory",
    "Rule",
    "SampledDetections",
    "SampledObjects",
    "fit_acceleration_noise",
    "fit_acceleration_noise_by_class",
    "fit_curvilinear",
    "fit_curvilinear_by_class",
    "fit_interactions",
    "fit_position_noise",
    "fit_score_calibration",
    "fit_sensor",
    "fit_trajectory_noise",
    "hidden_objects",
    "learn_confusion",
    "learn_sizes",
    "match_to_truth",
    "measured_trajectories",
    "negative_log_likelihood",
    "sample_with_tracker",
    "sample_with_truth",
]
