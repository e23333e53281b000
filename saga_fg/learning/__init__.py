"""What can be learned from recordings: for now the process noise of own motion."""

from saga_fg.learning.process_noise import Sightings, fit_acceleration_noise

__all__ = ["Sightings", "fit_acceleration_noise"]
