"""Scenes of pairs in which one follows the other at a known rate, drawn from the model itself."""

import numpy as np

from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

RATE, NOISE, STEP = 1.0, 0.05, 0.1  # 1/s; m^2/s^3 of a follower; s
GAP = 10.0  # m


def following_pairs(pairs=6, moments=120, seed=0, label="car", apart=200.0, name="pairs"):
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
    position = np.zeros((moments, 2 * pairs, 3))
    position[..., 0] = places.reshape(moments, -1)
    position[..., 1] = np.tile(apart * np.arange(pairs), 2)
    position[..., :2] += rng.normal(0, 0.005, position[..., :2].shape)
    return scene_of(position, label, name)


def scene_of(position, label="car", name="scene", step=STEP):
    """Objects at positions (K, N, 3) heading along x, detected wherever they are labelled; NaN: neither."""
    time, truth, frames = step * np.arange(len(position)), [], []
    for t, places in zip(time.tolist(), position, strict=True):
        there = np.isfinite(places[:, 0])
        n = int(there.sum())
        size, unknown = np.tile([4.0, 1.8, 1.5], (n, 1)), np.full((n, 2), np.nan)
        boxes = Boxes(np.full(n, label), places[there], size, np.zeros(n), unknown)
        ids = np.array([f"{k:03d}" for k in np.flatnonzero(there)], dtype=np.str_)
        truth.append(Annotations(ids, boxes, np.ones(n, dtype=bool)))
        frames.append(Frame(t, "lidar", Detections(boxes, np.full(n, 0.99)), np.eye(4)))
    return Scene(name, time, np.tile(np.eye(4), (len(time), 1, 1)), ("",) * len(time), frames, truth)
