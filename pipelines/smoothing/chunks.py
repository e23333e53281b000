"""Chunks of a recording that is smoothed as it is read; they follow each other without a gap.

    [a, b) is smoothed within [a - margin, b + margin]        b = a + length, earlier where there are enough detections

Labels are written for the moments of the chunk alone; beyond the margins measurements have no influence on it. Memory
and work follow the detections in a chunk and its margins, so that crowds are cut into shorter ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.settings import NonNegative, Positive, Range, Settings, setting
from saga_fg.types.frame import Frame


@dataclass(frozen=True)
class ChunkSettings(Settings):
    """Lengths of the chunks of a long recording."""

    length: Positive = setting(30.0, "length of a chunk, s; higher: more memory")
    margin: Positive = setting(7.0, "time smoothed beyond either end of a chunk, s")
    detections: Annotated[int, Range(1, 10**9)] = setting(60_000, "number of detections that ends a chunk early")
    shortest: NonNegative = setting(5.0, "least length of a chunk that ends early, s")


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame, its time of measurement (s), and the tracks (n,) of its usable detections, -1 for none."""

    time: float
    frame: Frame
    track_of: IntArray


class Backlog:
    """The part of a recording still needed: tracked frames in order of time, and moments at which boxes are wanted."""

    def __init__(self, settings: ChunkSettings) -> None:
        self._settings = settings
        self._frames: list[TrackedFrame] = []
        self._moments = np.empty(0)
        self._begin: float | None = None  # of the next chunk

    def extend(self, frames: list[TrackedFrame]) -> None:
        """Take in frames that were tracked."""
        self._frames += frames

    def want(self, moments: FloatArray) -> None:
        """Boxes are wanted at these times (m,), s, too: later ones than before."""
        self._moments = np.concatenate([self._moments, moments])

    @property
    def tracked(self) -> float:
        """Time of the newest frame, s; -inf before the first."""
        return self._frames[-1].time if self._frames else -np.inf

    def chunks(self, until: float) -> Iterator[tuple[float, float]]:
        """The spans [begin, end), s, that are complete, with their margins, before a time; infinite: all that is left.

        Frames that later chunks do not need are forgotten when the next chunk is asked for.
        """
        length, margin = self._settings.length, self._settings.margin
        if self._begin is None:
            if not self._frames and not len(self._moments):
                return
            self._begin = self._oldest(np.inf)
        while len(self._moments):
            end = self._end(self._begin)
            last = until == np.inf and end + margin >= max(self._moments[-1], self.tracked)
            if end + margin >= until and not last:
                return
            yield self._begin, (np.inf if last else end)
            if last:
                return
            self._frames = [tracked for tracked in self._frames if tracked.time >= end - margin]
            self._moments = self._moments[self._moments >= end - margin]
            pause = self._oldest(end) - margin - end
            self._begin = end + max(0.0, pause // length) * length  # past empty chunks

    def around(self, begin: float, end: float) -> tuple[list[TrackedFrame], FloatArray]:
        """The frames of a chunk with its margins, and the times (m,), s, that are wanted."""
        first, last = begin - self._settings.margin, end + self._settings.margin
        wanted = self._moments[(self._moments >= first) & (self._moments < last)]
        return [tracked for tracked in self._frames if first <= tracked.time < last], wanted

    def _end(self, begin: float) -> float:
        """End of a chunk: after its length, or once it has enough detections."""
        settings, count = self._settings, 0
        for tracked in self._frames:
            if tracked.time >= begin:
                count += len(tracked.track_of)
                if count >= settings.detections:
                    return min(max(tracked.time, begin + settings.shortest), begin + settings.length)
        return begin + settings.length

    def _oldest(self, otherwise: float) -> float:
        """Time of the first frame or moment that is left, s."""
        return min([*self._moments[:1].tolist(), *(tracked.time for tracked in self._frames[:1])], default=otherwise)
