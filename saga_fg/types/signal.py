r"""The colour of a traffic light: a hidden Markov belief over red, amber and green, in continuous time.

    colours change red -> green -> amber -> red, each after an exponential time of its mean duration:
    p(t + dt) = p(t) exp(G dt),    G_kk = -1 / duration_k,    G_k,next(k) = 1 / duration_k
    p_k <- p_k P(reported colour | k) / sum,    P = accuracy for the true colour, (1 - accuracy) / 2 for each other

The belief is the discrete part of a hybrid node; it mixes the interaction functions of the node's edges: with
probability p_closed = p_red + p_amber a stop line acts, else it does not, so that its rate is multiplied by p_closed,
which is the mean of the two dynamics (the first moment of an interacting-multiple-model prediction, Blom and Bar-Shalom
1988); `likeliest` selects the likelier of the two instead.

Source: Rabiner, A tutorial on hidden Markov models, 1989 (forward recursion).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg

from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Positive, Settings, setting

COLOURS = ("red", "amber", "green")
COLOUR_LABELS = tuple(f"traffic_light_{colour}" for colour in COLOURS)  # labels of detections that report a colour
LEAST_BELIEF = 1e-6  # no colour is ever ruled out


@dataclass(frozen=True)
class SignalSettings(Settings):
    """Colour changes of traffic lights, and the effect of the belief on stop lines."""

    red_duration: Positive = setting(
        15.0, "mean duration of red, s; usual 10 to 60; higher: lights are believed to stay red longer"
    )
    amber_duration: Positive = setting(
        3.0, "mean duration of amber, s; usual 3 to 5; higher: lights are believed to stay amber longer"
    )
    green_duration: Positive = setting(
        15.0, "mean duration of green, s; usual 10 to 60; higher: lights are believed to stay green longer"
    )
    max_distance: Positive = setting(
        4.0,
        "a reported light belongs to no known light further away than this, m; usual 2 to 6; higher: more "
        "reports are used, more of them wrongly",
    )
    belief: Literal["mixed", "likeliest"] = setting(
        "mixed", "effect of a stop line: mixed: by the probability that it is closed; likeliest: all or nothing"
    )

    @cached_property
    def generator(self) -> FloatArray:
        """G (3, 3), 1/s."""
        red, amber, green = 1 / self.red_duration, 1 / self.amber_duration, 1 / self.green_duration
        return np.array([[-red, 0, red], [amber, -amber, 0], [0, green, -green]])

    @property
    def stationary(self) -> FloatArray:
        """(3,) belief without observations: the shares of the durations."""
        durations = np.array([self.red_duration, self.amber_duration, self.green_duration])
        return np.asarray(durations / durations.sum())

    def predicted(self, belief: FloatArray, dt: float) -> FloatArray:
        """Beliefs (n, 3) dt seconds later."""
        return np.asarray(belief @ scipy.linalg.expm(self.generator * dt))

    def closed(self, belief: FloatArray) -> FloatArray:
        """(n,) weight with which stop lines of lights with these beliefs (n, 3) act."""
        chance = belief[:, 0] + belief[:, 1]
        return np.asarray(chance if self.belief == "mixed" else (chance > 0.5).astype(np.float64))


def colour_updated(belief: FloatArray, colour: int, accuracy: float) -> FloatArray:
    """The belief (3,) after a report of a colour (its number) that is right with the chance `accuracy`."""
    likelihood = np.full(len(COLOURS), (1 - accuracy) / 2)
    likelihood[colour] = accuracy
    posterior = np.maximum(belief * likelihood, 0.0)
    posterior = np.maximum(posterior / posterior.sum(), LEAST_BELIEF)
    return np.asarray(posterior / posterior.sum())
