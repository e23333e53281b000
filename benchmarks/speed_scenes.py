"""Columns of cars for measuring speed: any number of objects, loosely or densely connected.

Loosely: lanes far apart, in each a queue of five with the shipped edge rules: who is in plain view is hardly tied to
others. Densely: cars side by side, each tied to the four around it by a rate of 0.5 /s: one connected graph.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pipelines.config import TrackConfig, load_config
from saga_fg.model.edge_rules import Neighbours
from saga_fg.model.interactions import SharedVelocity
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame

Ties = Literal["loose", "dense"]
INTERVAL, SPEED, NOISE, DETECTED = 0.1, 12.0, 0.15, 0.9  # s, m/s, m, share
QUEUE = 5
LABEL, SIZE = "car", (4.5, 1.9, 1.6)


def speed_frames(count: int, ties: Ties, frames: int, seed: int) -> list[Frame]:
    """Frames of `count` cars that drive along; each is missed now and then, nothing false is detected."""
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    if ties == "loose":
        column, row, across, along = k // QUEUE % 50, k // QUEUE // 50 * (QUEUE + 5) + k % QUEUE, 12.0, 20.0
    else:
        side = int(np.ceil(np.sqrt(count)))
        column, row, across, along = k % side, k // side, 4.0, 12.0
    place = np.stack([row * along, column * across], axis=-1) + rng.normal(scale=(1.0, 0.3), size=(count, 2))
    speed, found = SPEED + rng.normal(scale=0.5, size=count), []
    for number in range(frames):
        place[:, 0] += speed * INTERVAL
        speed += rng.normal(scale=0.1, size=count)
        seen = np.flatnonzero(rng.random(count) < DETECTED)
        z = np.zeros((len(seen), 3))
        z[:, :2] = place[seen] + rng.normal(scale=NOISE, size=(len(seen), 2))
        label, size, unknown = np.full(len(seen), LABEL), np.tile(SIZE, (len(seen), 1)), np.full((len(seen), 2), np.nan)
        boxes = Boxes.of(label, z, size, np.zeros(len(seen)), unknown)
        found.append(Frame(number * INTERVAL, "lidar", Detections(boxes, np.full(len(seen), 0.9)), None))
    return found


def speed_config(ties: Ties) -> TrackConfig:
    """The shipped configuration of recorded traffic; where cars are densely connected, with edges of their own."""
    config = load_config("traffic")
    if ties == "loose":
        return config
    around = Neighbours(
        SharedVelocity(), rate=0.5, distance_scale=15.0, max_distance=20.0, max_degree=4, classes=(LABEL,)
    )
    return replace(config, tracker=replace(config.tracker, edges=(around,)))
