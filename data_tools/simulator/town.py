"""A town of streets on a grid: houses, fences, lamps, trees and parked cars, for simulated drives that come back.

Nodes are crossings; rows and columns of streets are 80 to 120 m apart. Some streets have the houses of another one, or
row houses that repeat every few metres: places that look alike and are not the same. Half of the parked cars leave or
come at some time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.scanner import StaticWorld
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.boxes import Boxes

NODES = 5  # in each direction
_SPACING = (80.0, 120.0)  # m between streets
_OPEN = 12.0  # m from a crossing that is free of houses
_ALIKE, _ROWS = 0.2, 0.2  # shares of streets with the houses of another one, and with row houses
_CAR = np.array([4.4, 1.8, 1.5])


@dataclass(frozen=True, eq=False)
class Town:
    """crossings (NODES, NODES, 2), m; world: all that ever stands there; present (n, 2): from when until when each of
    its boxes is there, in shares of a lap.
    """

    crossings: FloatArray
    world: StaticWorld
    present: FloatArray

    @classmethod
    def of(cls, rng: np.random.Generator) -> Town:
        """A random town."""
        x, y = (np.concatenate([[0.0], np.cumsum(rng.uniform(*_SPACING, NODES - 1))]) for _ in range(2))
        crossings = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        boxes, poles, present = [], [], []
        seeds: list[tuple[int, bool]] = []
        for start, end in _streets(crossings):
            seed = int(rng.integers(2**31)), bool(rng.random() < _ROWS)
            if seeds and rng.random() < _ALIKE:
                seed = seeds[int(rng.integers(len(seeds)))]
            seeds.append(seed)
            length = float(np.linalg.norm(end - start))
            houses = _houses(np.random.default_rng(seed[0]), length, seed[1])
            cars, times = _parked(rng, length)
            boxes.append(_placed(houses.append(cars), start, end))
            present += [np.tile([0.0, np.inf], (len(houses), 1)), times]
            poles.append(_poles(rng, start, end))
        world = StaticWorld(Boxes.concatenate(boxes), np.concatenate(poles))
        return cls(crossings, world, np.concatenate(present))

    def at(self, time: float) -> StaticWorld:
        """The static world at a time, in laps: boxes present then, and all poles."""
        there = (self.present[:, 0] <= time) & (time < self.present[:, 1])
        return replace(self.world, boxes=self.world.boxes.select(there))


def _streets(crossings: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    n = len(crossings)
    across = [(crossings[i, j], crossings[i + 1, j]) for i in range(n - 1) for j in range(n)]
    along = [(crossings[i, j], crossings[i, j + 1]) for i in range(n) for j in range(n - 1)]
    return across + along


def _houses(rng: np.random.Generator, length: float, alike: bool) -> Boxes:
    """Houses and fences on both sides of a street along the x axis."""
    label, position, size = [], [], []
    for side in (-1.0, 1.0):
        x = _OPEN + rng.uniform(0.0, 4.0)
        while x < length - _OPEN - 6.0:
            long, deep, high, back = rng.uniform([7.0, 5.0, 3.5, 7.5], [18.0, 9.0, 10.0, 10.5]).tolist()
            gap, fence = float(rng.uniform(1.5, 7.0)), bool(rng.random() < 0.5)
            if alike:
                long, deep, high, back, gap, fence = 9.0, 7.0, 6.0, 8.0, 3.0, False
            long = min(long, length - _OPEN - x)
            label.append("house")
            position.append((x + long / 2, side * (back + deep / 2), high / 2))
            size.append((long, deep, high))
            x += long
            if fence:
                label.append("fence")
                position.append((x + gap / 2, side * 7.3, 0.6))
                size.append((gap, 0.2, 1.2))
            x += gap
    n = len(label)
    return Boxes.of(label, position, size, np.zeros(n), np.zeros((n, 2)))


def _parked(rng: np.random.Generator, length: float) -> tuple[Boxes, FloatArray]:
    """Cars at both kerbs, and from when until when they stand there."""
    slots = np.arange(_OPEN + 4.0, length - _OPEN - 4.0, 7.0)
    x = np.concatenate([slots, slots])
    side = np.repeat([-1.0, 1.0], len(slots))
    taken = rng.random(len(x)) < 0.35
    x, side = x[taken] + rng.uniform(-1.0, 1.0, int(taken.sum())), side[taken]
    n = len(x)
    position = np.column_stack([x, side * (4.9 + rng.uniform(-0.15, 0.15, n)), np.full(n, _CAR[2] / 2)])
    size, yaw = _CAR * rng.uniform(0.9, 1.15, (n, 3)), rng.normal(0.0, 0.03, n)
    moment, kind = rng.random(n), rng.integers(4, size=n)  # two of four stay
    times = np.column_stack([np.where(kind == 2, moment, 0.0), np.where(kind == 3, moment, np.inf)])
    return Boxes.of(["car"] * n, position, size, yaw, np.zeros((n, 2))), times


def _poles(rng: np.random.Generator, start: FloatArray, end: FloatArray) -> FloatArray:
    """Lamps and trees (n, 4) along a street."""
    length = float(np.linalg.norm(end - start))
    lamps = np.arange(_OPEN, length - _OPEN, 26.0) + rng.uniform(0.0, 6.0)
    trees = np.arange(_OPEN, length - _OPEN, 9.0)
    trees = trees[rng.random(len(trees)) < 0.4]
    trees = trees + rng.uniform(-2.0, 2.0, len(trees))
    x = np.concatenate([lamps, trees])
    y = rng.choice([-1.0, 1.0], len(x)) * (6.4 + rng.uniform(-0.2, 0.2, len(x)))
    radius = np.concatenate([np.full(len(lamps), 0.1), rng.uniform(0.12, 0.35, len(trees))])
    height = np.concatenate([np.full(len(lamps), 6.0), np.full(len(trees), 4.0)])
    u = (end - start) / length
    place = start + x[:, None] * u + y[:, None] * np.array([-u[1], u[0]])
    return np.column_stack([place, radius, height])


def _placed(boxes: Boxes, start: FloatArray, end: FloatArray) -> Boxes:
    """Boxes of a street along the x axis, along the street from `start` to `end`."""
    T = np.eye(4)
    u = (end - start) / np.linalg.norm(end - start)
    T[:2, :2], T[:2, 3] = np.array([[u[0], -u[1]], [u[1], u[0]]]), start
    return boxes.transformed(T)
