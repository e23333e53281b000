"""Settings learned from recordings."""

from pipelines.learning.interactions import learn_interactions, learned_figures, learned_tables, scenes_to_learn_from
from pipelines.learning.noise import LearnedNoise, learn_noise, learned_fragment, learned_motions, offset_fragment

__all__ = [
    "LearnedNoise",
    "learn_interactions",
    "learn_noise",
    "learned_figures",
    "learned_fragment",
    "learned_motions",
    "learned_tables",
    "offset_fragment",
    "scenes_to_learn_from",
]
