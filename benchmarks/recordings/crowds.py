"""Crowds: pedestrians who cross each other's way, simulated, and those recorded by ETH.

Simulated ones walk in three streams, `WIDTH` m wide, that meet in the middle. A pedestrian keeps to a course of its
own at its own speed, and gives way to others by social forces (Helbing and Molnar, Physical Review E 51, 1995),
so that two pass each other at 0.3 to 1 m. A sensor sees them from a mast `RATE` times a second, some behind others.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from benchmarks.recordings.eth_ucy import EthUcy
from benchmarks.recordings.traffic import PERIOD, RecordedTraffic, Recordings, on_grid
from saga_fg.numerics import FloatArray, IntArray, StrArray

RATE = 2.5  # frames a second, as the recorded ones are annotated
DURATION, STEP = 40.0, 0.02  # s; of the integration
WIDTH, REACH = 3.0, 9.0  # m, of a stream; half of its length
COURSES = np.radians([0.0, 155.0, 260.0])  # of the streams, no end of which is near another
FLOW = 0.5  # pedestrians a second and stream
SPEED, SPEED_DEVIATION = 1.34, 0.26  # m/s
RELAXATION = 0.5  # s, in which a pedestrian comes back to its velocity
FORCE, FORCE_RANGE = 16.0, 0.17  # m/s^2 at no distance; m, over which it falls by e
SWAY = 0.25  # m/s^1.5, of the acceleration that nobody explains
SIZE = (0.6, 0.6)  # m
WINDOW = 60.0  # s of a recorded scene
GAP = 0.9  # s between annotations, across which a recorded place is interpolated


def simulated_crowds(scenes: int, seed: int = 0) -> Recordings:
    """Recordings of crossing streams."""
    names = tuple(f"crowd-{k}" for k in range(scenes))
    return Recordings(names, lambda name: _walked(name, np.random.default_rng([seed, zlib.crc32(name.encode())])))


def _walked(name: str, rng: np.random.Generator) -> RecordedTraffic:
    steps, every = round((DURATION + 2 * REACH / SPEED) / STEP), round(PERIOD / STEP)
    first = round(2 * REACH / SPEED / PERIOD)
    x, v, wish, number = np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    rows, courses = [], np.column_stack([np.cos(COURSES), np.sin(COURSES)])
    total = 0
    for k in range(steps + 1):
        for course in courses[rng.random(len(courses)) < FLOW * STEP]:
            aside = np.array([-course[1], course[0]]) * rng.uniform(-WIDTH / 2, WIDTH / 2)
            turn, speed = rng.normal(0, 0.1), max(rng.normal(SPEED, SPEED_DEVIATION), 0.6)
            ahead = speed * (course + turn * np.array([-course[1], course[0]]))
            x, v = np.concatenate([x, [aside - REACH * course]]), np.concatenate([v, [ahead]])
            wish, number, total = np.concatenate([wish, [ahead]]), np.append(number, total), total + 1
        apart = x[:, None] - x
        distance = np.hypot(*np.moveaxis(apart, 2, 0)) + 1e-9
        np.fill_diagonal(distance, np.inf)
        away = (FORCE * np.exp(-distance / FORCE_RANGE) / distance)[:, :, None] * apart
        noise = SWAY * rng.normal(size=x.shape) / np.sqrt(STEP)
        v = v + STEP * ((wish - v) / RELAXATION + away.sum(axis=1) + noise)
        x = x + STEP * v
        here = (x * wish).sum(axis=1) <= REACH * np.hypot(*wish.T)
        x, v, wish, number = x[here], v[here], wish[here], number[here]
        if k % every == 0 and k // every >= first:
            rows.append((np.full(len(x), k // every - first), number, x, v))
    moment, who, place, velocity = (np.concatenate(column) for column in zip(*rows, strict=True))
    return _pedestrians(name, moment, who.astype(np.str_), place, velocity)


def _pedestrians(
    name: str, moment: IntArray, who: StrArray, place: FloatArray, velocity: FloatArray
) -> RecordedTraffic:
    sizes = dict.fromkeys(who.tolist(), ("pedestrian", *SIZE))
    return on_grid(name, moment, who, (place, velocity, np.arctan2(velocity[:, 1], velocity[:, 0])), sizes)


def recorded_crowds(root: Path) -> Recordings:
    """Windows of the recordings eth and hotel below `root`, each of `WINDOW` s; places are interpolated."""
    dataset, windows = EthUcy(root), {}
    for recording in dataset.scenes:
        scene = dataset.scene(recording)
        for k in range(int((scene.timestamps[-1] - scene.timestamps[0]) // WINDOW)):
            windows[f"{recording}-{k:02d}"] = (recording, scene.timestamps[0] + k * WINDOW)

    def read(name: str) -> RecordedTraffic:
        recording, start = windows[name]
        scene = dataset.scene(recording)
        assert scene.ground_truth is not None
        time = np.concatenate([[t] * len(a) for t, a in zip(scene.timestamps, scene.ground_truth, strict=True)])
        who = np.concatenate([a.id for a in scene.ground_truth])
        place = np.concatenate([a.boxes.position[:, :2] for a in scene.ground_truth])
        velocity = np.concatenate([a.boxes.velocity for a in scene.ground_truth])
        rows = []
        for one in np.unique(who):
            own = np.flatnonzero((who == one) & np.isfinite(velocity).all(axis=1))
            t, x, v = time[own] - start, place[own], velocity[own]
            for i in np.flatnonzero(np.diff(t) < GAP):
                k = np.arange(np.ceil(t[i] / PERIOD - 1e-6), np.ceil(t[i + 1] / PERIOD - 1e-6)).astype(np.int64)
                k = k[(k >= 0) & (k * PERIOD <= WINDOW)]
                h = t[i + 1] - t[i]
                s = ((k * PERIOD - t[i]) / h)[:, None]
                at = (
                    (2 * s**3 - 3 * s**2 + 1) * x[i]
                    + (s**3 - 2 * s**2 + s) * h * v[i]
                    + (3 * s**2 - 2 * s**3) * x[i + 1]
                    + (s**3 - s**2) * h * v[i + 1]
                )
                rows.append((k, np.full(len(k), one), at, (1 - s) * v[i] + s * v[i + 1]))
        moment, names, at, speed = (np.concatenate(column) for column in zip(*rows, strict=True))
        return _pedestrians(name, moment, names, at, speed)

    return Recordings(tuple(windows), read)
