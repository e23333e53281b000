"""A robot with a planar laser and poor wheels that drives round the corridor of a building.

The corridor runs round a block; niches and cupboards of random size make places tell apart. Wheels turn too far by a
constant share and at random, so that odometry does not close. All is known: the true poses come with the log.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_tools.files.atomic_files import write_text
from data_tools.laser import LaserLog
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.planar_poses import transforms

_OUTER, _WIDTH = (30.0, 20.0), 3.0  # m: the building, its corridor
_STEP, _PERIOD = 0.15, 0.2  # m and s between scans
_READINGS, _REACH, _NOISE = 180, 20.0, 0.01  # of a scan; m
_BIAS, _SPREAD = 0.006, 0.01  # rad per m that the wheels turn too far, and rad per root metre at random
_NOTHING = 81.91  # m, what the laser says where it hits nothing


def laser_drive(seed: int, rounds: float = 1.5) -> tuple[LaserLog, FloatArray]:
    """A log of a drive, and the true poses (n, 3, 3), the first one at the origin."""
    rng = np.random.default_rng(seed)
    walls = _walls(rng)
    x = _path(rounds)
    n = len(x)
    angles = np.asarray(-np.pi / 2 + np.pi / _READINGS * np.arange(_READINGS), dtype=np.float64)
    ranges = np.stack([_rays(walls, pose, angles) for pose in x])
    ranges = ranges + _NOISE * rng.normal(size=ranges.shape)
    ranges[ranges > _REACH] = np.nan
    true = transforms(x)
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    way = np.hypot(steps[:, 0, 2], steps[:, 1, 2])
    turn = np.arctan2(steps[:, 1, 0], steps[:, 0, 0]) + _BIAS * way + _SPREAD * np.sqrt(way) * rng.normal(size=n - 1)
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    ahead = 1.02 * way  # wheels a little too small
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
    corners = np.array([[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes])
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)


def _path(rounds: float) -> FloatArray:
    """Poses (n, 3): x, y, heading along the middle of the corridor, with round corners."""
    (w, h), m, r = _OUTER, _WIDTH / 2, 1.0
    long, short = w - 2 * m - 2 * r, h - 2 * m - 2 * r
    lengths = np.array([long, r * np.pi / 2, short, r * np.pi / 2] * 2)
    ends = np.cumsum(lengths)
    way = np.arange(0.0, rounds * ends[-1], _STEP)
    turned = 2 * np.pi * (way // ends[-1])
    part = np.searchsorted(ends, way % ends[-1], side="right")
    inside = way % ends[-1] - (ends - lengths)[part]
    heading = turned + np.pi / 2 * (part // 2) + np.where(part % 2 == 1, inside / r, 0.0)
    middle = (heading[1:] + heading[:-1]) / 2
    steps = _STEP * np.stack([np.cos(middle), np.sin(middle)], axis=1)
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
