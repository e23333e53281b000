"""Settings learned from recordings."""

from pipelines.learning.fragment import learned_fragment
from pipelines.learning.noise import LearnedNoise, learn_noise, learned_motions
from pipelines.learning.offsets import offset_fragment
from pipelines.learning.scenes import scenes_to_learn_from

__all__ = [
    "LearnedNoise",
    "learn_noise",
    "learned_fragment",
    "learned_motions",
    "offset_fragment",
    "scenes_to_learn_from",
]
