"""Simulated LiDAR drives through a town, on a closed course that passes places again, in both directions.

The vehicle keeps to the right, turns at crossings in arcs and slows down for them. A lap of 1.6 to 2.1 km
passes two stretches again, one of them at least in the opposite direction; driving on into the next lap, it passes the
first streets again. A scan is made when it is read, always the same for its row, so that a drive takes no memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from data_tools.lidar import Scan
from data_tools.simulator.scanner import ScannerSettings, simulate_scan
from data_tools.simulator.street import SENSOR_HEIGHT, SMALL
from data_tools.simulator.town import NODES, Town
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, IntArray

_STREETS = 20  # of a lap
_LANE, _TURN = 1.75, 10.0  # m right of the middle of the road, and from a crossing where turning begins
_SPEED, _SLOW, _ACCELERATION = 8.0, 4.0, 1.5  # m/s, in turns, m/s^2
_STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
_AHEAD = 180.0  # m into the second lap, unless told


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Straights and arcs: start (n, 3): x, y, heading; length (n,), curvature (n,), 1/m."""

    start: FloatArray
    length: FloatArray
    curvature: FloatArray

    def at(self, way: FloatArray) -> FloatArray:
        """x, y, heading (k, 3) at ways (k,) within a lap."""
        ends = np.cumsum(self.length)
        row = np.minimum(np.searchsorted(ends, way, side="right"), len(ends) - 1)
        s, k = way - (ends - self.length)[row], self.curvature[row]
        x, y, heading = self.start[row].T
        half = s * k / 2
        chord = s * np.sinc(half / np.pi)
        return np.column_stack(
            [x + chord * np.cos(heading + half), y + chord * np.sin(heading + half), heading + s * k]
        )


class SimulatedCourse:
    """Scans of a drive through the town of a seed: `data_tools.lidar.scan.ScanSequence` with the true poses.

    length    of the drive, m; None: a lap, and `_AHEAD` of the next
    period    between scans, s
    lap       length of a lap, m; way (K,): driven until each scan, m
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
        self.town = Town.of(rng)
        self._pieces = _pieces(self.town.crossings, _walk(rng))
        self.lap = float(self._pieces.length.sum())
        self.way, self._speed = self._driven(self.lap + _AHEAD if length is None else length, period)
        self.timestamps: FloatArray = period * np.arange(len(self.way), dtype=np.float64)
        x, y, heading = self._pieces.at(self.way % self.lap).T
        self.ego_T_lidar: FloatArray = np.eye(4)
        self.world_T_ego: FloatArray = np.tile(np.eye(4), (len(self.way), 1, 1))
        c, s = np.cos(heading), np.sin(heading)
        self.world_T_ego[:, 0, 0], self.world_T_ego[:, 0, 1], self.world_T_ego[:, 0, 3] = c, -s, x
        self.world_T_ego[:, 1, 0], self.world_T_ego[:, 1, 1], self.world_T_ego[:, 1, 3] = s, c, y
        self.world_T_ego[:, 2, 3] = SENSOR_HEIGHT

    def __len__(self) -> int:
        return len(self.way)

    def __getitem__(self, row: int) -> Scan:
        row = range(len(self))[row]
        way = float(self.way[row])
        ends = np.cumsum(self._pieces.length)
        piece = min(int(np.searchsorted(ends, way % self.lap, side="right")), len(ends) - 1)
        speed = float(self._speed[row])
        velocity = np.array([0.0, 0.0, speed * self._pieces.curvature[piece], speed, 0.0, 0.0])
        rng = np.random.default_rng([self._seed, row])
        world = self.town.at(way / self.lap)
        return simulate_scan(world, self.world_T_ego[row], rng, self._settings, velocity if self._skewed else None)

    def _driven(self, length: float, period: float) -> tuple[FloatArray, FloatArray]:
        """Way (K,) and speed (K,) at each scan of a drive that slows down before turns."""
        n = max(int(self.lap), 2)
        grid = np.linspace(0.0, self.lap, n, endpoint=False)
        step, ends = self.lap / n, np.cumsum(self._pieces.length)
        turning = self._pieces.curvature[np.searchsorted(ends, grid, side="right").clip(max=len(ends) - 1)] != 0
        square = np.where(turning, _SLOW, _SPEED) ** 2
        for direction in (1, -1):
            for k in range(direction, 2 * n * direction, direction):  # twice round, as the lap is closed
                square[k % n] = min(square[k % n], square[(k - direction) % n] + 2 * _ACCELERATION * step)
        speed = np.sqrt(square)
        laps = int(np.ceil(length / self.lap)) + 1
        speed = np.tile(speed, laps)
        time = np.concatenate([[0.0], np.cumsum(step / speed)])[:-1]
        way = step * np.arange(len(speed))
        moments = np.arange(0.0, np.interp(length, way, time), period)
        return np.interp(moments, time, way), np.interp(moments, time, speed)


def revisits(
    world_T_ego: FloatArray, near: float = 6.0, apart: float = 60.0, least: float = 30.0
) -> list[tuple[int, int]]:
    """First and last row of each stretch of poses (K, 4, 4), of `least` m or more, that was driven before.

    near: m to an earlier pose, `apart` m of way before
    """
    from scipy.spatial import cKDTree

    place = world_T_ego[:, :2, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    tree = cKDTree(place)
    again = np.array([(way[rows] < way[k] - apart).any() for k, rows in enumerate(tree.query_ball_point(place, near))])
    rows: IntArray = np.flatnonzero(again)
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
    return [(int(run[0]), int(run[-1])) for run in runs if way[run[-1]] - way[run[0]] >= least]


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
    for k, (a, b) in enumerate(zip(nodes[:-1].tolist(), nodes[1:].tolist(), strict=True)):
        street = (*min(a, b), *max(a, b))
        if street in first:
            again.append((k, first[street]))
        first.setdefault(street, k)
    once = len({old for _, old in again}) == len(again)
    if not once or not 2 <= len(again) <= 5:
        return False
    runs = 1 + sum(k != before + 1 for (before, _), (k, _) in pairwise(again))
    opposite = [headings[k] != headings[old] for k, old in again]
    return runs == 2 and any(opposite) and again[-1][0] < len(headings) - 2


def _pieces(crossings: FloatArray, walk: IntArray) -> _Pieces:
    """The lane along a closed walk: straights from crossing to crossing, and arcs, from the first straight on."""
    start, length, curvature = [], [], []
    n = len(walk)
    for k in range(n):
        a, b, c = (crossings[tuple(walk[(k + i) % n])] for i in range(3))
        u, w = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
        right = np.array([u[1], -u[0]])
        heading = float(np.arctan2(u[1], u[0]))
        start.append([*(a + _TURN * u + _LANE * right), heading])
        length.append(float(np.linalg.norm(b - a)) - 2 * _TURN)
        curvature.append(0.0)
        turn = float(u[0] * w[1] - u[1] * w[0])  # 1: to the left
        start.append([*(b - _TURN * u + _LANE * right), heading])
        radius = _TURN + _LANE * turn
        length.append(2 * _TURN if abs(turn) < 0.5 else radius * np.pi / 2)
        curvature.append(0.0 if abs(turn) < 0.5 else turn / radius)
    return _Pieces(np.array(start), np.array(length), np.array(curvature))
