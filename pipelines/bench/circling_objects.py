"""Objects on circles of their own, for benchmarks of the service."""

from __future__ import annotations

from typing import Any

import numpy as np

INTERVAL = 0.1  # s between frames
NOISE = 0.2  # of detections, m


class CirclingObjects:
    """`number` cars within 200 m, each on a circle of 20 m."""

    def __init__(self, number: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 2])
        self._centre = rng.uniform(-200, 200, (number, 2))
        self._phase = rng.uniform(0, 2 * np.pi, number)

    def detections(self, time: float, rng: np.random.Generator) -> list[dict[str, Any]]:
        """All of them at a time, s, with noise, as a message has them."""
        angle = self._phase + 0.3 * time
        position = self._centre + 20 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        position = position + rng.normal(0, NOISE, position.shape)
        return [{"label": "car", "x": x, "y": y, "score": 0.9} for x, y in position.round(3).tolist()]
