"""What can be learned from recordings: noise, scores and detection probability of sensors, process noise of motion."""

from saga_fg.learning.detection_sample import DetectionSample
from saga_fg.learning.measurement_noise import fit_position_noise
from saga_fg.learning.process_noise import Sightings, fit_acceleration_noise
from saga_fg.learning.score_calibration import fit_score_calibration
from saga_fg.learning.sensor_fit import fit_sensor
from saga_fg.learning.truth_matches import MatchedFrame, match_to_truth, sample_with_truth

__all__ = [
    "DetectionSample",
    "MatchedFrame",
    "Sightings",
    "fit_acceleration_noise",
    "fit_position_noise",
    "fit_score_calibration",
    "fit_sensor",
    "match_to_truth",
    "sample_with_truth",
]
