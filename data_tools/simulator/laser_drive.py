"""A robot with a planar laser and poor wheels that drives round the corridor of a building.

The corridor runs round a block; niches and cupboards of random size make places tell apart. Wheels turn too far by a
constant share and at random, so that odometry does not close. All is known: the true poses come with the log.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.laser import LaserLog
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import transforms

_OUTER, _WIDTH = (30.0, 20.0), 3.0  # m: the building, its corridor
_PERIOD = 0.2  # s between scans
_BIAS, _SPREAD = 0.006, 0.01  # rad per m that the wheels turn too far, and rad per root metre at random
_NOTHING = 81.91  # m, what the laser says where it hits nothing


@dataclass(frozen=True)
class LaserKind:
    """A laser and its robot.

    readings over `field`, rad; reach, noise (standard deviation) and steps between scans, m; missing: share of readings
    that hit nothing; wheels: ratio of the way that they tell to the true one; people: who walk ahead of the robot
    """

    readings: int = 180
    field: float = np.pi
    reach: float = 20.0
    noise: float = 0.01
    missing: float = 0.0
    step: float = 0.15
    wheels: float = 1.02
    people: int = 0


def laser_drive(seed: int, rounds: float = 1.5, kind: LaserKind | None = None) -> tuple[LaserLog, FloatArray]:
    """A log of a drive, and the true poses (n, 3, 3), the first one at the origin."""
    rng, kind = np.random.default_rng(seed), kind or LaserKind()
    walls = _walls(rng)
    x = _path(rounds, kind.step)
    n = len(x)
    whole = kind.readings - kind.readings % 2
    angles = np.asarray(kind.field * (np.arange(kind.readings) / whole - 0.5), dtype=np.float64)
    ranges = np.stack([_rays(_with_people(walls, kind.people, k, pose), pose, angles) for k, pose in enumerate(x)])
    ranges = ranges + kind.noise * rng.normal(size=ranges.shape)
    ranges[ranges > kind.reach] = np.nan
    if kind.missing > 0:
        ranges[rng.random(ranges.shape) < kind.missing] = np.nan
    true = transforms(x)
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    way = np.hypot(steps[:, 0, 2], steps[:, 1, 2])
    turn = np.arctan2(steps[:, 1, 0], steps[:, 0, 0]) + _BIAS * way + _SPREAD * np.sqrt(way) * rng.normal(size=n - 1)
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    ahead = kind.wheels * way
    place = np.stack([np.cumsum(ahead * np.cos(heading[:-1])), np.cumsum(ahead * np.sin(heading[:-1]))], axis=1)
    odometry = np.column_stack([np.concatenate([np.zeros((1, 2)), place]), heading])
    time = np.asarray(_PERIOD * np.arange(n), dtype=np.float64)
    log = LaserLog(time, ranges, angles, odometry, np.zeros(3))
    return log, np.linalg.inv(true[0]) @ true


def write_carmen(path: str | Path, log: LaserLog) -> None:
    """Write a log as FLASER records."""
    lines = ["# message formats defined: PARAM SYNC ODOM FLASER"]
    for time, ranges, pose in zip(log.time, np.nan_to_num(log.ranges, nan=_NOTHING), log.odometry, strict=True):
        at = " ".join(f"{value:.6f}" for value in pose)
        readings = " ".join(f"{r:.3f}" for r in ranges)
        lines.append(f"FLASER {len(ranges)} {readings} {at} {at} {time:.6f} nohost {time:.6f}")
    write_text(path, "\n".join(lines) + "\n")


def _walls(rng: np.random.Generator) -> FloatArray:
    """Segments (k, 2, 2) of the walls."""
    (w, h), inset = _OUTER, _WIDTH
    boxes = [(0.0, 0.0, w, h), (inset, inset, w - inset, h - inset)]
    for _ in range(24):  # cupboards along the outer wall, and niches in it
        along, deep, long = rng.uniform(0.08, 0.92), rng.uniform(-0.8, 0.4), rng.uniform(0.4, 1.5)
        side = int(rng.integers(4))
        if side % 2 == 0:
            x, y = along * w, 0.0 if side == 0 else h
            boxes.append((x, y, x + long, y + (deep if side == 0 else -deep)))
        else:
            x, y = w if side == 1 else 0.0, along * h
            boxes.append((x, y, x + (-deep if side == 1 else deep), y + long))
    return _sides(boxes)


def _with_people(walls: FloatArray, people: int, k: int, pose: FloatArray) -> FloatArray:
    """Segments with boxes of people who walk ahead at scan k, each off to another side, and draw away by and by."""
    boxes = []
    for number in range(people):
        far = 1.5 + (0.01 * k + 2.5 * number) % 5
        turn = pose[2] + 0.3 * np.sin(0.05 * k + 2 * number)
        x, y = pose[:2] + far * np.array([np.cos(turn), np.sin(turn)])
        boxes.append((x - 0.15, y - 0.1, x + 0.15, y + 0.1))
    return np.concatenate([walls, _sides(boxes)]) if boxes else walls


def _sides(boxes: list[tuple[float, float, float, float]]) -> FloatArray:
    """Segments (k, 2, 2) of boxes: x and y of two corners."""
    corners = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes])
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _path(rounds: float, step: float) -> FloatArray:
    """Poses (n, 3): x, y, heading along the middle of the corridor, with round corners."""
    (w, h), m, r = _OUTER, _WIDTH / 2, 1.0
    long, short = w - 2 * m - 2 * r, h - 2 * m - 2 * r
    lengths = np.array([long, r * np.pi / 2, short, r * np.pi / 2] * 2)
    ends = np.cumsum(lengths)
    way = np.arange(0.0, rounds * ends[-1], step)
    turned = 2 * np.pi * (way // ends[-1])
    part = np.searchsorted(ends, way % ends[-1], side="right")
    inside = way % ends[-1] - (ends - lengths)[part]
    heading = turned + np.pi / 2 * (part // 2) + np.where(part % 2 == 1, inside / r, 0.0)
    middle = (heading[1:] + heading[:-1]) / 2
    steps = step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    place = np.array([m + r, m]) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([place, heading])


def _rays(walls: FloatArray, pose: FloatArray, angles: FloatArray) -> FloatArray:
    """Ranges (m,) from a pose (3,)."""
    u = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)
    a, e = walls[:, 0] - pose[:2], walls[:, 1] - walls[:, 0]
    across = u[:, None, 0] * e[None, :, 1] - u[:, None, 1] * e[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        far = (a[None, :, 0] * e[None, :, 1] - a[None, :, 1] * e[None, :, 0]) / across
        along = (a[None, :, 0] * u[:, None, 1] - a[None, :, 1] * u[:, None, 0]) / across
    hit = (far > 0.02) & (along >= 0) & (along <= 1)
    return np.asarray(np.where(hit, far, np.inf).min(axis=1))
