"""What can be learned from recordings: noise, scores and detection probability of sensors, process noise of motion,
and interactions."""

from saga_fg.learning.class_confusion import learn_confusion
from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.learning.gap_prediction import errors_alone, gap_errors, negative_log_likelihood, predict_gaps
from saga_fg.learning.gaps import GapSample, GapSettings, gap_ends, gap_moments, sample_gaps
from saga_fg.learning.held_out_fit import FORMS_OF_TRACKERS, fit_by_held_out
from saga_fg.learning.independent_filter import FilteredTrajectories, filter_independently
from saga_fg.learning.interaction_fit import TEMPLATE, FittedInteractions, fit_interactions, predict_with
from saga_fg.learning.joint_fit import fit_interactions_in_view
from saga_fg.learning.joint_gaps import JointGaps
from saga_fg.learning.measurement_noise import fit_position_noise
from saga_fg.learning.network_fit import fit_networks
from saga_fg.learning.own_motion_fit import OwnMotion, OwnMotionLikelihood
from saga_fg.learning.process_noise import Sightings, fit_acceleration_noise, fit_acceleration_noise_by_class
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.learning.sensor_fit import fit_sensor
from saga_fg.learning.trail_noise import fit_trail_noise
from saga_fg.learning.trails import Trail, follow
from saga_fg.learning.trajectories import Trajectories
from saga_fg.learning.truth_matches import GATE, MatchedFrame, match_to_truth, sample_with_truth

__all__ = [
    "FORMS_OF_TRACKERS",
    "GATE",
    "TEMPLATE",
    "DetectionSample",
    "FilteredTrajectories",
    "FittedInteractions",
    "GapSample",
    "GapSettings",
    "JointGaps",
    "MatchedFrame",
    "OwnMotion",
    "OwnMotionLikelihood",
    "Sightings",
    "Trail",
    "Trajectories",
    "errors_alone",
    "filter_independently",
    "fit_acceleration_noise",
    "fit_acceleration_noise_by_class",
    "fit_by_held_out",
    "fit_interactions",
    "fit_interactions_in_view",
    "fit_networks",
    "fit_position_noise",
    "fit_score_calibration",
    "fit_sensor",
    "fit_trail_noise",
    "follow",
    "gap_ends",
    "gap_errors",
    "gap_moments",
    "learn_confusion",
    "match_to_truth",
    "negative_log_likelihood",
    "predict_gaps",
    "predict_with",
    "sample_gaps",
    "sample_with_truth",
]
