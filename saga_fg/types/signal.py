r"""The state of a traffic light: a hidden Markov belief in continuous time, from reported colours and from who moves.

    red -> starting -> green -> amber -> red, each after an exponential time of its mean duration:
    p(t + dt) = p(t) exp(G dt),    G_kk = -1 / duration_k,    G_k,next(k) = 1 / duration_k
    p_k <- p_k P(reported colour | k) / sum,    P = accuracy for the true colour, (1 - accuracy) / 2 for each other
    p_k <- p_k N(dv; a_k T, V) / sum            first vehicle before a line: its change of speed dv in T seconds

`starting` is green as well: drivers have not reacted yet. a_k is the acceleration that the edge rules expect in state
k (`saga_fg.tracking.signal_inference`).

The belief is the discrete part of a hybrid node; it mixes the interaction functions of the node's edges: with
probability p_closed = p_red + p_amber a stop line holds traffic, with p_green it lets it go, so that the rates of those
edges are multiplied by them, which is the mean of the dynamics (the first moment of an interacting-multiple-model
prediction, Blom and Bar-Shalom 1988); `likeliest` selects the likelier one instead.

Source: Rabiner, A tutorial on hidden Markov models, 1989 (forward recursion).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import scipy.linalg

from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import Positive, Range, Settings, setting

COLOURS = ("red", "amber", "green")
STATES = ("red", "amber", "starting", "green")
COLOUR_OF_STATE = np.array([0, 1, 2, 2])  # (4,) numbers in COLOURS
COLOUR_LABELS = tuple(f"traffic_light_{colour}" for colour in COLOURS)  # labels of detections that report a colour
LEAST_BELIEF = 1e-6  # no state is ever ruled out
MAX_LIGHT_DISTANCE = 4.0  # a reported light belongs to no known light further away than this, m


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
    start_delay: Positive = setting(
        1.5,
        "mean time from green until the first driver starts, s; usual 1 to 2; higher: queues are expected to "
        "start later",
    )
    driver_noise: Positive = setting(
        2.0,
        "spectral density of the acceleration of drivers before a line about that of the rules, m^2/s^3; usual 0.5 to "
        "4; higher: colours are inferred from traffic more slowly",
    )
    non_compliance: Annotated[float, Range(0, 1, above=True)] = setting(
        0.1,
        "share of drivers who do not drive as the light tells them, as they turn at red or cannot leave at green; "
        "usual 0.05 to 0.3; higher: one vehicle tells less; 1: colours are not inferred from traffic",
    )
    belief: Literal["mixed", "likeliest"] = setting(
        "mixed", "effect of a stop line: mixed: by the probability that it is closed; likeliest: all or nothing"
    )

    @cached_property
    def _durations(self) -> FloatArray:
        """(4,) s."""
        return np.array([self.red_duration, self.amber_duration, self.start_delay, self.green_duration])

    @cached_property
    def generator(self) -> FloatArray:
        """G (4, 4), 1/s."""
        following = np.array([STATES.index(name) for name in ("starting", "red", "green", "amber")])
        G = -np.diag(1 / self._durations)
        G[np.arange(len(STATES)), following] = 1 / self._durations
        return G

    @property
    def stationary(self) -> FloatArray:
        """(4,) belief without observations: the shares of the durations."""
        return np.asarray(self._durations / self._durations.sum())

    def predicted(self, belief: FloatArray, dt: float) -> FloatArray:
        """Beliefs (n, 4) dt seconds later."""
        return np.asarray(belief @ scipy.linalg.expm(self.generator * dt))

    def closed(self, belief: FloatArray) -> FloatArray:
        """(n,) weight with which stop lines of lights with these beliefs (n, 4) hold traffic."""
        return self._weight(belief[:, 0] + belief[:, 1])

    def open(self, belief: FloatArray) -> FloatArray:
        """(n,) weight with which stop lines of lights with these beliefs (n, 4) let waiting vehicles go."""
        return self._weight(belief[:, 3])

    def _weight(self, chance: FloatArray) -> FloatArray:
        return np.asarray(chance if self.belief == "mixed" else (chance > 0.5).astype(np.float64))


def colours(belief: FloatArray) -> FloatArray:
    """Probabilities (3,) of red, amber and green of a belief (4,)."""
    return np.asarray(np.bincount(COLOUR_OF_STATE, belief, len(COLOURS)), dtype=np.float64)


def colour_updated(belief: FloatArray, colour: int, accuracy: float) -> FloatArray:
    """The belief (4,) after a report of a colour (its number) that is right with the chance `accuracy`."""
    return updated(belief, np.log(np.where(colour == COLOUR_OF_STATE, accuracy, (1 - accuracy) / 2) + 1e-300))


def updated(belief: FloatArray, log_likelihood: FloatArray) -> FloatArray:
    """The belief (4,) after an observation with these logarithms of its likelihoods (4,)."""
    posterior = belief * np.exp(log_likelihood - log_likelihood.max())
    posterior = np.maximum(posterior / posterior.sum(), LEAST_BELIEF)
    return np.asarray(posterior / posterior.sum())
