r"""Information gain of an edge: how much the velocity of its source says about that of its target.

    gain_ij = s_i^2 / ( s_i^2 + s_j^2 + spread^2 ),     s^2 = variance of the velocity + ( unseen_acceleration t )^2

This is the gain of a Kalman filter that takes the velocity of j, off by the spread, for a measurement of that of i. A
detected object learns more from its detections than from neighbours, who pull on a bus that brakes for its stop; a
hidden one soon has nothing else to go by. t is the time since an object was last detected: the variance that a filter
states rests on the noise of corrected states, and an object out of sight may have braked since. The gain of edges into
detected objects is therefore low.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import NonNegative, Settings, setting, settings_group


def information_setting() -> Any:
    """The field of an edge rule that holds its `EdgeInformation`."""
    return settings_group(
        lambda: None,
        "weight edges by their information gain, as edges into well-known velocities tell little; null: full weight",
    )


@dataclass(frozen=True)
class EdgeInformation(Settings):
    """Weight edges by their information gain."""

    spread: NonNegative = setting(
        0.5, "standard deviation of the difference between the velocities of a pair, m/s; higher: edges gain less"
    )
    unseen_acceleration: NonNegative = setting(
        0.0, "growth of the velocity deviation of undetected objects, m/s^2; higher: edges out of them gain less"
    )

    def variances(self, nodes: NodeTable) -> FloatArray:
        """s^2 (n,) of the module."""
        if nodes.unseen is None:
            return nodes.velocity_variance
        return np.asarray(nodes.velocity_variance + (self.unseen_acceleration * nodes.unseen) ** 2)
