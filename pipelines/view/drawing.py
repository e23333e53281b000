"""Drawings for any viewer: shapes with a name, in a frame of coordinates, at a time.

    scenes.py -> `Drawing`s in order of time -> writers.py

Frames are a tree of names: `Drawing(frame="scene/ego", name="lidar", shape=Pose(...))` says where the frame
`scene/ego/lidar` is in `scene/ego`. A drawing replaces the one before it of the same name.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray

VEHICLE = (4.6, 1.9, 1.6)  # length, width, height of the box drawn for the vehicle, m
Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255. Shapes have one of them for all, (1, 3), or one each, (N, 3)."""
Facts = Mapping[str, Sequence[str]]
"""Columns of texts by name, a row for each thing; the first column holds their identifiers."""


@dataclass(frozen=True, eq=False)
class Solids:
    """N boxes, or ellipsoids if `round`: centre and size (N, 3), m, yaw (N,), rad; facts of each, or none.

    size: length, width, height
    """

    centre: FloatArray
    size: FloatArray
    yaw: FloatArray
    colour: IntArray
    facts: Facts = field(default_factory=dict)
    round: bool = False

    @property
    def labels(self) -> list[str]:
        """The facts of each solid in a line; empty without facts."""
        return [" ".join(row) for row in zip(*self.facts.values(), strict=True)]


@dataclass(frozen=True, eq=False)
class Lines:
    """N strips of points (n, 3), m; radius (1,) or (N,), m."""

    strips: Sequence[FloatArray]
    colour: IntArray
    radius: FloatArray


@dataclass(frozen=True, eq=False)
class Arrows:
    """N arrows from their tail (N, 3), m, along a vector (N, 2) in the plane, m."""

    tail: FloatArray
    vector: FloatArray
    colour: IntArray
    radius: float


@dataclass(frozen=True, eq=False)
class Points:
    """N points (N, 3), m, drawn with a radius, m; with their names, or a cloud without."""

    points: FloatArray
    colour: IntArray
    radius: float
    names: Sequence[str] | None = None


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose (4, 4) of a frame in its parent."""

    parent_T_child: FloatArray


Shape = Solids | Lines | Arrows | Points | Pose


@dataclass(frozen=True, eq=False)
class Drawing:
    """A shape in a frame.

    frame   frame of the shape's coordinates
    name    of the layer, below that of the frame; of a pose: of the frame that it places
    time    s from the start, None for a static shape
    moment  row of the scene's moment, if it belongs to one
    """

    frame: str
    name: str
    shape: Shape
    time: float | None = None
    moment: int | None = None

    @property
    def path(self) -> str:
        """The name with the names of all frames above it."""
        return f"{self.frame}/{self.name}"


def in_order(*drawings: Iterable[Drawing]) -> Iterator[Drawing]:
    """Merge sequences of drawings, each in order of time; static ones come first."""
    return heapq.merge(*drawings, key=lambda each: -np.inf if each.time is None else each.time)


def one_colour(colour: Colour) -> IntArray:
    """Return a colour for all shapes, (1, 3)."""
    return np.array([colour], dtype=np.int64)
