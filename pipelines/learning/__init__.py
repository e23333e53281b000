"""Settings learned from recordings."""

from pipelines.learning.interactions import scenes_to_learn_from
from pipelines.learning.noise import LearnedNoise, learn_noise, learned_fragment, learned_motions, offset_fragment

__all__ = [
    "LearnedNoise",
    "learn_noise",
    "learned_fragment",
    "learned_motions",
    "offset_fragment",
    "scenes_to_learn_from",
]
