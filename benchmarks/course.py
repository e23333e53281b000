"""Simulated LiDAR drives through a town, on a closed course that passes places again, in both directions.

The vehicle keeps to the right, turns at crossings in arcs and slows down for them. A lap of 1.6 to 2.1 km
passes two stretches again, one of them at least in the opposite direction; driving on into the next lap, it passes the
first streets again. A scan is made when it is read, always the same for its row, so that a drive takes no memory.

The town's streets form a grid, with houses, fences, lamps, trees and parked cars; rows and columns of streets are 80 to
120 m apart. Some streets have the houses of another one, or row houses that repeat every few metres: places that look
alike and are not the same. Half of the parked cars leave or come at some time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.scans import SENSOR_HEIGHT, SMALL, ScannerSettings, StaticWorld, simulate_scan
from data_tools.lidar import Scan
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray, IntArray, transforms
from saga_fg.types import Boxes

NODES = 5  # crossings of the town in each direction
_SPACING = (80.0, 120.0)  # m between streets
_OPEN = 12.0  # m from a crossing that is free of houses
_ALIKE, _ROWS = 0.2, 0.2  # shares of streets with the houses of another one, and with row houses
_CAR = np.array([4.4, 1.8, 1.5])
_STREETS = 20  # of a lap
_LANE, _TURN = 1.75, 10.0  # m right of the middle of the road, and from a crossing where turning begins
_SPEED, _SLOW, _ACCELERATION = 8.0, 4.0, 1.5  # m/s, in turns, m/s^2
_STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
_AHEAD = 180.0  # m into the second lap, unless told


@dataclass(frozen=True, eq=False)
class Town:
    """crossings (NODES, NODES, 2), m; world: all that ever stands there; present (n, 2): from when until when each of
    its boxes is there, in shares of a lap.
    """

    crossings: FloatArray
    world: StaticWorld
    present: FloatArray

    @classmethod
    def sample(cls, rng: np.random.Generator) -> Town:
        """A random town."""
        x, y = (np.concatenate([[0.0], np.cumsum(rng.uniform(*_SPACING, NODES - 1))]) for _ in range(2))
        at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        ends = [(at[i, j], at[i + 1, j]) for i in range(NODES - 1) for j in range(NODES)]
        ends += [(at[i, j], at[i, j + 1]) for i in range(NODES) for j in range(NODES - 1)]
        boxes, poles, present = [], [], []
        seeds: list[tuple[int, bool]] = []
        for start, end in ends:
            seed = int(rng.integers(2**31)), bool(rng.random() < _ROWS)
            seeds.append(seeds[int(rng.integers(len(seeds)))] if seeds and rng.random() < _ALIKE else seed)
            length = float(np.linalg.norm(end - start))
            houses = _houses(np.random.default_rng(seeds[-1][0]), length, seeds[-1][1])
            cars, times = _parked(rng, length)
            T, u = np.eye(4), (end - start) / length
            T[:2, :2], T[:2, 3] = np.array([[u[0], -u[1]], [u[1], u[0]]]), start
            boxes.append(houses.append(cars).transformed(T))
            present += [np.tile([0.0, np.inf], (len(houses), 1)), times]
            poles.append(_poles(rng, start, u, length))
        return cls(at, StaticWorld(Boxes.concatenate(boxes), np.concatenate(poles)), np.concatenate(present))

    def at(self, time: float) -> StaticWorld:
        """The static world at a time, in laps: boxes present then, and all poles."""
        there = (self.present[:, 0] <= time) & (time < self.present[:, 1])
        return replace(self.world, boxes=self.world.boxes.select(there))


def _houses(rng: np.random.Generator, length: float, alike: bool) -> Boxes:
    """Houses and fences on both sides of a street along the x axis."""
    found = []
    for side in (-1.0, 1.0):
        x = _OPEN + rng.uniform(0.0, 4.0)
        while x < length - _OPEN - 6.0:
            long, deep, high, back = rng.uniform([7.0, 5.0, 3.5, 7.5], [18.0, 9.0, 10.0, 10.5]).tolist()
            gap, fence = float(rng.uniform(1.5, 7.0)), bool(rng.random() < 0.5)
            if alike:
                long, deep, high, back, gap, fence = 9.0, 7.0, 6.0, 8.0, 3.0, False
            long = min(long, length - _OPEN - x)
            found.append(("house", (x + long / 2, side * (back + deep / 2), high / 2), (long, deep, high)))
            x += long
            if fence:
                found.append(("fence", (x + gap / 2, side * 7.3, 0.6), (gap, 0.2, 1.2)))
            x += gap
    label, position, size = zip(*found, strict=True)
    return Boxes.of(label, position, size, np.zeros(len(found)), np.zeros((len(found), 2)))


def _parked(rng: np.random.Generator, length: float) -> tuple[Boxes, FloatArray]:
    """Cars at both kerbs, and from when until when they stand there."""
    slots = np.arange(_OPEN + 4.0, length - _OPEN - 4.0, 7.0)
    x, side = np.tile(slots, 2), np.repeat([-1.0, 1.0], len(slots))
    taken = rng.random(len(x)) < 0.35
    n = int(taken.sum())
    x, side = x[taken] + rng.uniform(-1.0, 1.0, n), side[taken]
    position = np.column_stack([x, side * (4.9 + rng.uniform(-0.15, 0.15, n)), np.full(n, _CAR[2] / 2)])
    size, yaw = _CAR * rng.uniform(0.9, 1.15, (n, 3)), rng.normal(0.0, 0.03, n)
    moment, kind = rng.random(n), rng.integers(4, size=n)  # two of four stay
    times = np.column_stack([np.where(kind == 2, moment, 0.0), np.where(kind == 3, moment, np.inf)])
    return Boxes.of(["car"] * n, position, size, yaw, np.zeros((n, 2))), times


def _poles(rng: np.random.Generator, start: FloatArray, u: FloatArray, length: float) -> FloatArray:
    """Lamps and trees (n, 4) along a street in the direction u."""
    lamps = np.arange(_OPEN, length - _OPEN, 26.0) + rng.uniform(0.0, 6.0)
    trees = np.arange(_OPEN, length - _OPEN, 9.0)
    trees = trees[rng.random(len(trees)) < 0.4]
    x = np.concatenate([lamps, trees + rng.uniform(-2.0, 2.0, len(trees))])
    y = rng.choice([-1.0, 1.0], len(x)) * (6.4 + rng.uniform(-0.2, 0.2, len(x)))
    radius = np.concatenate([np.full(len(lamps), 0.1), rng.uniform(0.12, 0.35, len(trees))])
    height = np.repeat([6.0, 4.0], [len(lamps), len(trees)])
    return np.column_stack([start + x[:, None] * u + y[:, None] * np.array([-u[1], u[0]]), radius, height])


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Straights and arcs: start (n, 3): x, y, heading; length (n,), curvature (n,), 1/m."""

    start: FloatArray
    length: FloatArray
    curvature: FloatArray

    def rows(self, distance: FloatArray) -> IntArray:
        """The piece (k,) at distances (k,) within a lap."""
        ends = np.cumsum(self.length)
        return np.minimum(np.searchsorted(ends, distance, side="right"), len(ends) - 1)

    def at(self, distance: FloatArray) -> FloatArray:
        """x, y, heading (k, 3) at distances (k,) within a lap."""
        row = self.rows(distance)
        s, k = distance - (np.cumsum(self.length) - self.length)[row], self.curvature[row]
        x, y, heading = self.start[row].T
        half = s * k / 2
        chord, along = s * np.sinc(half / np.pi), heading + half
        return np.column_stack([x + chord * np.cos(along), y + chord * np.sin(along), heading + s * k])


class SimulatedCourse:
    """Scans of a drive through the town of a seed: `data_tools.lidar.scan.ScanSequence` with the true poses.

    length    of the drive, m; None: a lap, and `_AHEAD` of the next
    period    between scans, s
    lap       length of a lap, m; distance (K,): driven until each scan, m
    """

    def __init__(
        self,
        seed: int,
        length: float | None = None,
        period: float = 0.1,
        settings: ScannerSettings = SMALL,
        skewed: bool = True,
    ) -> None:
        if (length is not None and not length > 0) or not period > 0:
            raise InputError(f"expected a length > 0 m and a period > 0 s, got {length!r} and {period!r}")
        rng = np.random.default_rng(seed)
        self._seed, self._settings, self._skewed = seed, settings, skewed
        self.town = Town.sample(rng)
        self._pieces = _pieces(self.town.crossings, _walk(rng))
        self.lap = float(self._pieces.length.sum())
        self.distance, self._speed = self._driven(self.lap + _AHEAD if length is None else length, period)
        self.timestamps: FloatArray = period * np.arange(len(self), dtype=np.float64)
        planar = transforms(self._pieces.at(self.distance % self.lap))
        self.ego_T_lidar: FloatArray = np.eye(4)
        self.world_T_ego: FloatArray = np.tile(np.eye(4), (len(self), 1, 1))
        self.world_T_ego[:, :2, :2], self.world_T_ego[:, :2, 3] = planar[:, :2, :2], planar[:, :2, 2]
        self.world_T_ego[:, 2, 3] = SENSOR_HEIGHT

    def __len__(self) -> int:
        return len(self.distance)

    def __getitem__(self, row: int) -> Scan:
        row = range(len(self))[row]
        curvature = self._pieces.curvature[self._pieces.rows(self.distance[row] % self.lap)]
        speed, rng = float(self._speed[row]), np.random.default_rng([self._seed, row])
        velocity = np.array([0.0, 0.0, speed * curvature, speed, 0.0, 0.0]) if self._skewed else None
        world = self.town.at(float(self.distance[row]) / self.lap)
        return simulate_scan(world, self.world_T_ego[row], rng, self._settings, velocity)

    def _driven(self, length: float, period: float) -> tuple[FloatArray, FloatArray]:
        """Distance (K,) and speed (K,) at each scan of a drive that slows down before turns."""
        n = max(int(self.lap), 2)
        step, pieces = self.lap / n, self._pieces
        turning = pieces.curvature[pieces.rows(np.linspace(0.0, self.lap, n, endpoint=False))] != 0
        square = np.where(turning, _SLOW, _SPEED) ** 2
        for direction in (1, -1):
            for k in range(direction, 2 * n * direction, direction):  # twice round, as the lap is closed
                square[k % n] = min(square[k % n], square[(k - direction) % n] + 2 * _ACCELERATION * step)
        speed = np.tile(np.sqrt(square), int(np.ceil(length / self.lap)) + 1)
        time = np.concatenate([[0.0], np.cumsum(step / speed)])[:-1]
        distance = step * np.arange(len(speed))
        moments = np.arange(0.0, np.interp(length, distance, time), period)
        return np.interp(moments, time, distance), np.interp(moments, time, speed)


def revisits(
    world_T_ego: FloatArray, near: float = 6.0, apart: float = 60.0, least: float = 30.0
) -> list[tuple[int, int]]:
    """First and last row of each stretch of poses (K, 4, 4), of `least` m or more, that was driven before.

    near: m to an earlier pose, `apart` m of the drive before
    """
    place = world_T_ego[:, :2, 3]
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    near_by = cKDTree(place).query_ball_point(place, near)
    rows = np.flatnonzero([(driven[rows] < driven[k] - apart).any() for k, rows in enumerate(near_by)])
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
    return [(int(run[0]), int(run[-1])) for run in runs if driven[run[-1]] - driven[run[0]] >= least]


def _walk(rng: np.random.Generator) -> IntArray:
    """Crossings (n, 2) of a closed walk without turning round, that passes two stretches twice."""
    while True:
        heading, headings = int(rng.integers(4)), list[int]()
        nodes = [rng.integers(NODES, size=2)]
        for _ in range(_STREETS):
            choices = [heading] if not headings else [(heading + turn) % 4 for turn in (-1, 0, 1)]
            choices = [h for h in choices if ((nodes[-1] + _STEPS[h] >= 0) & (nodes[-1] + _STEPS[h] < NODES)).all()]
            if not choices:
                break
            heading = choices[int(rng.integers(len(choices)))]
            headings.append(heading)
            nodes.append(nodes[-1] + _STEPS[heading])
        closed = len(headings) == _STREETS and (nodes[-1] == nodes[0]).all() and (headings[0] - heading) % 4 != 2
        if closed and _is_varied(np.array(nodes), headings):
            return np.array(nodes[:-1])


def _is_varied(nodes: IntArray, headings: list[int]) -> bool:
    """True if two stretches are passed twice, one of them in the opposite direction, and none three times."""
    first: dict[tuple[int, ...], int] = {}
    again = []
    for k, (a, b) in enumerate(pairwise(nodes.tolist())):
        old = first.setdefault((*min(a, b), *max(a, b)), k)
        if old != k:
            again.append((k, old))
    if len({old for _, old in again}) != len(again) or not 2 <= len(again) <= 5:
        return False
    runs = 1 + sum(k != before + 1 for (before, _), (k, _) in pairwise(again))
    opposite = any(headings[k] != headings[old] for k, old in again)
    return runs == 2 and opposite and again[-1][0] < len(headings) - 2


def _pieces(crossings: FloatArray, walk: IntArray) -> _Pieces:
    """The lane along a closed walk: straights from crossing to crossing, and arcs, from the first straight on."""
    found = []
    corners = [crossings[tuple(node)] for node in walk]
    for a, b, c in zip(corners, np.roll(corners, -1, axis=0), np.roll(corners, -2, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        u, w = (b - a) / length, (c - b) / np.linalg.norm(c - b)
        right, heading = np.array([u[1], -u[0]]), float(np.arctan2(u[1], u[0]))
        found.append(([*(a + _TURN * u + _LANE * right), heading], length - 2 * _TURN, 0.0))
        turn = float(u[0] * w[1] - u[1] * w[0])  # 1: to the left
        radius = _TURN + _LANE * turn
        arc = (2 * _TURN, 0.0) if abs(turn) < 0.5 else (radius * np.pi / 2, turn / radius)
        found.append(([*(b - _TURN * u + _LANE * right), heading], *arc))
    return _Pieces(*(np.array(column) for column in zip(*found, strict=True)))
