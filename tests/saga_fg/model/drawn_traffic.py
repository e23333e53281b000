"""Nodes in rows and bends, and the edges of a rule as dictionaries."""

from dataclasses import replace

import numpy as np

from saga_fg.conformance.programs import CAR
from saga_fg.model.interactions import NodeTable, Paths
from saga_fg.numerics.geometry import yaw_transform


def table(position, heading, speed=10.0, label="car", types=None):
    """Nodes that move along their headings."""
    position = np.asarray(position, dtype=float).reshape(-1, 2)
    n = len(position)
    heading, speed = np.broadcast_to(heading, n).astype(float), np.broadcast_to(speed, n)
    return NodeTable(
        id=np.arange(n) + 100,
        label=np.broadcast_to(np.asarray(label, dtype=np.str_), n),
        types=(CAR,) * n if types is None else tuple(types),
        position=position,
        velocity=np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1),
        heading=heading,
        length=np.full(n, 4.0),
        velocity_variance=np.ones(n),
    )


def straight(n, gap=12.0, lateral=0.0, start=0.0, heading=0.0):
    """n cars in a row, the first in front."""
    along = start - gap * np.arange(n)
    R = yaw_transform(yaw=heading)[:2, :2]
    return np.stack([along, np.full(n, lateral)], axis=-1) @ R.T, np.full(n, heading)


def bend(n, radius, gap=12.0, lateral=0.0, start=0.0):
    """n cars on a left-hand bend (negative radius: right-hand), the first in front; lateral is to the left."""
    angle = (start - gap * np.arange(n)) / radius
    inner = radius - lateral
    return np.stack([inner * np.sin(angle), radius - inner * np.cos(angle)], axis=-1), angle


def joined(*roads):
    return np.concatenate([p for p, _ in roads]), np.concatenate([h for _, h in roads])


def edges(pairs):
    """{target: {source: rate}}"""
    result = {}
    for i, j, rate in zip(pairs.target.tolist(), pairs.source.tolist(), pairs.rate.tolist(), strict=True):
        result.setdefault(i, {})[j] = rate
    return result


def leaders(pairs):
    assert len(set(pairs.target.tolist())) == len(pairs.target)
    return dict(zip(pairs.target.tolist(), pairs.source.tolist(), strict=True))


def random_traffic(rng, n=15):
    return table(rng.uniform(-25, 25, (n, 2)), rng.normal(0, 0.5, n), rng.uniform(0, 15, n))


def with_path(nodes, row, places, headings):
    """The nodes, one of which has a predicted path."""
    none = np.zeros((1, len(places)))
    path = Paths(np.array([row]), np.asarray(places)[None], np.asarray(headings)[None], none, none, *np.zeros((2, 1)))
    return replace(nodes, paths=path)
