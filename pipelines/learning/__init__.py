"""Settings learned from recordings."""

from pipelines.learning.fragment import learned_fragment
from pipelines.learning.noise import LearnedNoise, learn_noise

__all__ = ["LearnedNoise", "learn_noise", "learned_fragment"]
