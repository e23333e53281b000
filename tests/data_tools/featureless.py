"""Places where a LiDAR does not see the whole motion: a tunnel between two streets, and an open field."""

from __future__ import annotations

import numpy as np

from benchmarks.scans import StaticWorld, street
from saga_fg.types.boxes import Boxes

WIDTH, HEIGHT = 10.0, 6.0  # of the tunnel inside, m


def tunnel(start: float = -1000.0, end: float = 1000.0, seed: int | None = None) -> StaticWorld:
    """A straight tunnel on the x axis, its walls from x = `start` to `end`, m.

    seed: of streets before and behind it; None: there is nothing else
    """
    middle, length = (start + end) / 2, end - start
    side = (WIDTH + 1.0) / 2
    position = [(middle, -side, HEIGHT / 2), (middle, side, HEIGHT / 2), (middle, 0.0, HEIGHT + 0.5)]
    size = [(length, 1.0, HEIGHT), (length, 1.0, HEIGHT), (length, WIDTH + 2.0, 1.0)]
    walls = _boxes("tunnel", np.array(position), np.array(size))
    if seed is None:
        return StaticWorld(walls, np.empty((0, 4)))
    boxes, poles = [walls], []
    for number, at in enumerate((start - 55.0, end + 65.0)):  # a street extends from x = -60 to 123, m
        piece = street(seed + number)
        moved = Boxes(
            piece.boxes.label,
            piece.boxes.position + np.array([at, 0.0, 0.0]),
            piece.boxes.size,
            piece.boxes.yaw,
            piece.boxes.velocity,
        )
        reaches = np.abs(moved.position[:, 0] - middle) - moved.size[:, 0] / 2 >= length / 2
        across = np.abs(piece.boxes.position[:, 0] - 120.0) < 4.0  # the house that ends the first street
        boxes.append(moved.select(reaches & ~(across & (number == 0))))
        posts = piece.poles + np.array([at, 0.0, 0.0, 0.0])
        poles.append(posts[np.abs(posts[:, 0] - middle) > length / 2])
    return StaticWorld(Boxes.concatenate(boxes), np.concatenate(poles))


def open_field() -> StaticWorld:
    """Level ground."""
    return StaticWorld(_boxes("", np.empty((0, 3)), np.empty((0, 3))), np.empty((0, 4)))


def _boxes(label: str, position: np.ndarray, size: np.ndarray) -> Boxes:
    n = len(position)
    return Boxes(np.full(n, label), position, size, np.zeros(n), np.zeros((n, 2)))
