"""What can be learned from recordings: noise, scores and detection probability of sensors, process noise of motion."""

from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.learning.measurement_noise import fit_position_noise
from saga_fg.learning.process_noise import Sightings, fit_acceleration_noise, fit_acceleration_noise_by_class
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.learning.sensor_fit import fit_sensor
from saga_fg.learning.trail_noise import fit_trail_noise
from saga_fg.learning.trails import Trail, follow
from saga_fg.learning.truth_matches import GATE, MatchedFrame, match_to_truth, sample_with_truth

__all__ = [
    "GATE",
    "DetectionSample",
    "MatchedFrame",
    "Sightings",
    "Trail",
    "fit_acceleration_noise",
    "fit_acceleration_noise_by_class",
    "fit_position_noise",
    "fit_score_calibration",
    "fit_sensor",
    "fit_trail_noise",
    "follow",
    "match_to_truth",
    "sample_with_truth",
]
