"""Settings learned from recordings."""

from pipelines.learning.fragment import learned_fragment
from pipelines.learning.interactions import learn_interactions
from pipelines.learning.noise import LearnedNoise, learn_noise
from pipelines.learning.trajectory_sources import KINDS, TrajectorySource

__all__ = ["KINDS", "LearnedNoise", "TrajectorySource", "learn_interactions", "learn_noise", "learned_fragment"]
