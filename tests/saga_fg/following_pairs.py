"""Trajectories of pairs in which one follows the other at a known rate, drawn from the model itself."""

import numpy as np

from saga_fg.learning import Trajectories

RATE, NOISE, STEP = 1.0, 0.05, 0.1  # 1/s; m^2/s^3 of a follower; s
GAP = 10.0  # m


def following_pairs(pairs=6, moments=300, seed=0, label="car"):
    """Leaders wander in speed; followers, GAP behind, share it at RATE. Pairs are far from each other."""
    rng = np.random.default_rng(seed)
    inner = 4  # steps of the simulation in one of the recording
    h = STEP / inner
    v = np.full((2, pairs), 8.0) + rng.normal(0, 1, (2, pairs))
    x = np.stack([np.full(pairs, GAP), np.zeros(pairs)])
    places = np.zeros((moments, 2, pairs))
    for k in range(moments):
        places[k] = x
        for _ in range(inner):
            x = x + h * v
            pull = np.stack([0.3 * (8.0 - v[0]), RATE * (v[0] - v[1])])
            noise = np.sqrt(np.array([[1.5], [NOISE]]) * h) * rng.normal(size=(2, pairs))
            v = v + h * pull + noise
    position = np.zeros((moments, 2 * pairs, 2))
    position[..., 0] = places.reshape(moments, -1)
    position[..., 1] = np.tile(200.0 * np.arange(pairs), 2)
    position += rng.normal(0, 0.005, position.shape)
    n = 2 * pairs
    ids = np.array([f"{k:03d}" for k in range(n)])
    heading = np.zeros((moments, n))
    return Trajectories(STEP * np.arange(moments), ids, np.full(n, label), np.full(n, 4.0), position, heading)
