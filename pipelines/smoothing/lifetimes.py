"""What is said of an object as a whole, gathered while its recording streams by: size, score, front, identity.

A stretch of a recording knows its objects' positions; of their sizes, scores and fronts it knows a part. The parts are
summed: probabilities and looks of the score, metres and votes of the front, and of the size the weights of all values
that were measured, to half a millimetre. An object is what its tracklets are: one that was part of it before stays so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing import is_backwards, weighted_medians

RESOLUTION = 5e-4  # m, of the sizes that are kept
MOST_VALUES = 4096  # kept before equal ones are put together


class Lasting(NamedTuple):
    """Of an object, at the end: size (3,) m, score, and whether its front is where its directions say it is not."""

    size: FloatArray
    score: float
    backwards: bool


@dataclass
class _Weighed:
    """Values (m,), m, that were measured of a dimension, with their weights (m,); equal ones together."""

    value: FloatArray = field(default_factory=lambda: np.empty(0))
    weight: FloatArray = field(default_factory=lambda: np.empty(0))

    def add(self, value: FloatArray, weight: FloatArray) -> None:
        self.value = np.concatenate([self.value, value])
        self.weight = np.concatenate([self.weight, weight])
        if len(self.value) > MOST_VALUES:
            steps, index = np.unique(np.rint(self.value / RESOLUTION), return_inverse=True)
            self.value = steps * RESOLUTION
            self.weight = np.bincount(index, self.weight).astype(np.float64)

    def median(self) -> float:
        return float(weighted_medians(np.zeros(len(self.value), dtype=np.int64), 1, self.value, self.weight)[0])


def _unmeasured() -> tuple[_Weighed, ...]:
    """Length, width and height, of which nothing is known."""
    return _Weighed(), _Weighed(), _Weighed()


@dataclass(slots=True)
class _Life:
    """Of one object, so far: sums of the score and of the front along its direction; lengths, widths and heights."""

    probability: float = 0.0
    seen: int = 0
    looks: int = 0
    path: float = 0.0
    votes: float = 0.0
    yaw: float = np.nan  # the last that was given out
    sign: float = 1.0  # -1 where the directions given out are half a turn off those of the object's start
    sizes: tuple[_Weighed, ...] = field(default_factory=_unmeasured)

    def measure(self, size: FloatArray, weight: FloatArray) -> None:
        """Sizes (m, 3), m, with weights (m,)."""
        for column, values in zip(self.sizes, size.T, strict=True):
            column.add(values, weight)

    def median_size(self) -> FloatArray:
        """(3,) m, NaN where none was measured."""
        return np.array([column.median() for column in self.sizes])


class Lifetimes:
    """The objects of a recording by id. Those that are over keep nothing but what lasts."""

    def __init__(self) -> None:
        self._lives: dict[int, _Life] = {}
        self._over: dict[int, tuple[FloatArray, _Life]] = {}

    @property
    def ids(self) -> list[int]:
        """Of all objects that ever were, ascending."""
        return sorted([*self._lives, *self._over])

    def turned(self, id_: int, yaw: float) -> float:
        """-1 where directions of which `yaw` (rad) is one are half a turn off those before, of the object; else 1.

        `yaw` is at the moment of the last one given out.
        """
        life = self._lives.get(id_)
        if life is None or not np.isfinite(life.yaw) or not np.isfinite(yaw):
            return 1.0 if life is None else life.sign
        return life.sign * (-1.0 if np.cos(yaw - life.yaw) < 0 else 1.0)

    def seen(self, id_: int, probability: FloatArray, size: FloatArray, weight: FloatArray) -> None:
        """Detections (m,) of an object: their probability, size (m, 3) in m, NaN for unmeasured, and its weight."""
        life = self._life(id_)
        life.probability += float(probability.sum())
        life.seen += len(probability)
        known = np.isfinite(size).all(axis=1)
        life.measure(size[known], weight[known])

    def looked(self, id_: int, looks: int) -> None:
        """Frames that had the object in view."""
        self._life(id_).looks += looks

    def given_out(self, id_: int, sign: float, yaw: float, path: float, votes: float) -> None:
        """Directions up to `yaw` (rad), `turned` as told, with what says that they are right: metres and votes."""
        life = self._life(id_)
        life.path += sign * path
        life.votes += sign * votes
        life.sign, life.yaw = sign, yaw

    def retire(self, present: IntArray) -> None:
        """Put away what is kept of objects that are no longer present."""
        for id_ in self._lives.keys() - set(present.tolist()):
            life = self._lives.pop(id_)
            size = life.median_size()
            life.sizes = ()
            self._over[id_] = (size, life)

    def lasting(self, id_: int, prior_looks: float) -> Lasting:
        """Of an object that is over; prior_looks: looks without a detection that every object starts with."""
        size, life = self._over[id_]
        score = life.probability / (max(life.looks, life.seen, 1) + prior_looks)
        backwards = is_backwards(np.array([life.path]), np.array([life.votes]))
        return Lasting(size, score, bool(backwards[0]))

    def _life(self, id_: int) -> _Life:
        if id_ in self._over and id_ not in self._lives:  # it comes again
            size, life = self._over.pop(id_)
            life.sizes = _unmeasured()
            if np.isfinite(size).all():
                life.measure(size[None], np.array([float(max(life.seen, 1))]))
            self._lives[id_] = life
        return self._lives.setdefault(id_, _Life())
