"""Learn from recordings: noise, scores and detection probability of sensors, process noise, and interactions."""

from saga_fg.learning.class_confusion import learn_confusion
from saga_fg.learning.detection_sample import DetectionSample, SampledDetections, SampledObjects
from saga_fg.learning.filter_noise import FilterNoise, FilterNoiseLikelihood
from saga_fg.learning.gap_prediction import errors_alone, gap_errors, negative_log_likelihood, predict_gaps
from saga_fg.learning.gaps import GapSample, GapSettings, gap_ends, gap_moments, sample_gaps
from saga_fg.learning.held_out_fit import FORMS_OF_TRACKERS, fit_by_held_out
from saga_fg.learning.independent_filter import FilteredTrajectories, filter_independently
from saga_fg.learning.interaction_fit import TEMPLATE, FittedInteractions, fit_interactions, predict_with
from saga_fg.learning.joint_gaps import JointGaps
from saga_fg.learning.measurement_noise import fit_position_noise
from saga_fg.learning.network_fit import fit_networks
from saga_fg.learning.process_noise import (
    MeasuredTrajectory,
    fit_acceleration_noise,
    fit_acceleration_noise_by_class,
)
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.learning.sensor_fit import fit_sensor
from saga_fg.learning.tracked_trajectories import DetectedTrajectory, sample_with_tracker
from saga_fg.learning.trajectories import Trajectories
from saga_fg.learning.trajectory_noise import fit_trajectory_noise
from saga_fg.learning.truth_matches import (
    GATE,
    MatchedFrame,
    match_to_truth,
    measured_trajectories,
    sample_with_truth,
)

__all__ = [
    "FORMS_OF_TRACKERS",
    "GATE",
    "TEMPLATE",
    "DetectedTrajectory",
    "DetectionSample",
    "FilterNoise",
    "FilterNoiseLikelihood",
    "FilteredTrajectories",
    "FittedInteractions",
    "GapSample",
    "GapSettings",
    "JointGaps",
    "MatchedFrame",
    "MeasuredTrajectory",
    "SampledDetections",
    "SampledObjects",
    "Trajectories",
    "errors_alone",
    "filter_independently",
    "fit_acceleration_noise",
    "fit_acceleration_noise_by_class",
    "fit_by_held_out",
    "fit_interactions",
    "fit_networks",
    "fit_position_noise",
    "fit_score_calibration",
    "fit_sensor",
    "fit_trajectory_noise",
    "gap_ends",
    "gap_errors",
    "gap_moments",
    "learn_confusion",
    "match_to_truth",
    "measured_trajectories",
    "negative_log_likelihood",
    "predict_gaps",
    "predict_with",
    "sample_gaps",
    "sample_with_tracker",
    "sample_with_truth",
]
