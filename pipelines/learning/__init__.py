"""Settings learned from recordings."""

from pipelines.learning.fragment import learned_fragment
from pipelines.learning.interactions import learn_interactions
from pipelines.learning.noise import LearnedNoise, learn_noise
from pipelines.learning.trajectories import trajectories

__all__ = ["LearnedNoise", "learn_interactions", "learn_noise", "learned_fragment", "trajectories"]
