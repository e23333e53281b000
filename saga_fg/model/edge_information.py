r"""What an edge has to tell: how much there is to learn of its target's velocity from its source's.

    share_ij = s_i^2 / ( s_i^2 + s_j^2 + spread^2 ),     s^2 = variance of the velocity + ( unseen_acceleration t )^2

That is the gain of a Kalman filter that took the velocity of j, off by the spread, for a measurement of that of i. Of
what is in view, detections tell more than neighbours do, who pull a bus that brakes for its stop; what is hidden soon
has nobody else to go by. t is how long nobody has seen an object: the variance a filter states rests on the noise of
what detections correct, and who is out of sight may have braked since. So it tells nothing to those who are in view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.model.interactions import NodeTable
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import NonNegative, Settings, setting, settings_group


def news_setting() -> Any:
    """The field `news` of an edge rule."""
    return settings_group(lambda: None, "edges count by what they have to tell; null: whatever is known of their ends")


def counted(news: News | None, rate: FloatArray, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
    """Rates (E,) of edges source[k] -> target[k] (rows of `nodes`) as far as they have something to tell."""
    return rate if news is None else rate * news.shares(nodes, target, source)


@dataclass(frozen=True)
class News(Settings):
    """Edges count by what they have to tell."""

    spread: NonNegative = setting(0.5, "standard deviation of the difference between the velocities of a pair, m/s")
    unseen_acceleration: NonNegative = setting(
        0.0, "how much less sure a velocity is for every second in which nobody has seen its object, m/s^2"
    )

    def shares(self, nodes: NodeTable, target: IntArray, source: IntArray) -> FloatArray:
        """(E,) in [0, 1], of the edges source[k] -> target[k] (rows of `nodes`)."""
        variance = nodes.velocity_variance
        if nodes.unseen is not None:
            variance = variance + (self.unseen_acceleration * nodes.unseen) ** 2
        total = variance[target] + variance[source] + self.spread**2
        return np.divide(variance[target], total, out=np.zeros(len(target)), where=total > 0)
