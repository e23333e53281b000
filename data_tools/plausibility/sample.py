"""A sample of frames as arrays, and all checks over it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from data_tools.plausibility.checks import (
    ego_taken_for_world,
    far_too_fast,
    length_below_width,
    scores_beyond_one,
    strange_time_steps,
    unlikely_sizes,
    within_a_metre,
)
from data_tools.plausibility.doubt import Doubt
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray, StrArray
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Frame

MOST_FRAMES = 200


@dataclass(frozen=True, eq=False)
class Sample:
    """N detections of F frames of one recording.

    time (F,) s, sensor (F,), world_T_ego (F, 4, 4) NaN where unknown, in_world (F,): whether coordinates are "world";
    frame (N,), boxes, score (N,)
    """

    time: FloatArray
    sensor: StrArray
    world_T_ego: FloatArray
    in_world: BoolArray
    frame: IntArray
    boxes: Boxes
    score: FloatArray

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> Self:
        """The first frames of a recording."""
        first = frames[:MOST_FRAMES]
        unknown = np.full((4, 4), np.nan)
        poses = [unknown if frame.world_T_ego is None else frame.world_T_ego for frame in first]
        return cls(
            np.array([frame.timestamp for frame in first]),
            np.array([frame.sensor for frame in first], dtype=np.str_),
            np.array(poses).reshape(-1, 4, 4),
            np.array([frame.coordinates == "world" for frame in first], dtype=np.bool_),
            np.repeat(np.arange(len(first)), [len(frame) for frame in first]),
            Boxes.concatenate([frame.detections.boxes for frame in first]),
            np.concatenate([np.empty(0), *(frame.detections.score for frame in first)]),
        )


def doubts_of(sample: Sample, logits: Callable[[str], bool] = lambda sensor: False) -> list[Doubt]:
    """All that is doubtful in a sample. `logits` says of which sensors the scores are declared as such."""
    boxes, label = sample.boxes, sample.boxes.label
    declared = {name: logits(name) for name in np.unique(sample.sensor).tolist()}
    shares = np.array([not declared[name] for name in sample.sensor.tolist()], dtype=np.bool_)[sample.frame]
    found = (
        strange_time_steps(sample.time, sample.sensor),
        scores_beyond_one(sample.score[shares]),
        unlikely_sizes(label, boxes.size),
        length_below_width(label, boxes.size),
        within_a_metre(sample.frame, boxes.position),
        far_too_fast(label, boxes.velocity),
        ego_taken_for_world(sample.frame, boxes.position, sample.world_T_ego, sample.in_world, sample.sensor),
    )
    return [doubt for doubt in found if doubt is not None]
