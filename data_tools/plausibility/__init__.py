"""Doubts about data: what is probably wrong in them although it can be read, each with what mends it."""

from data_tools.plausibility.checks import (
    days_taken_for_times,
    ego_taken_for_world,
    far_too_fast,
    frames_taken_for_seconds,
    headings_in_degrees,
    length_below_width,
    scores_beyond_one,
    strange_time_steps,
    unlikely_sizes,
    within_a_metre,
)
from data_tools.plausibility.class_names import (
    idle_lanes,
    idle_rules,
    settings_without_data,
    usual_class,
    usual_classes,
)
from data_tools.plausibility.doubt import FILL_IN, Doubt, Mend
from data_tools.plausibility.sample import Sample, doubts_of

__all__ = [
    "FILL_IN",
    "Doubt",
    "Mend",
    "Sample",
    "days_taken_for_times",
    "doubts_of",
    "ego_taken_for_world",
    "far_too_fast",
    "frames_taken_for_seconds",
    "headings_in_degrees",
    "idle_lanes",
    "idle_rules",
    "length_below_width",
    "scores_beyond_one",
    "settings_without_data",
    "strange_time_steps",
    "unlikely_sizes",
    "usual_class",
    "usual_classes",
    "within_a_metre",
]
