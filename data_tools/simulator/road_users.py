"""Pedestrians of the simulator, and trajectories of N objects.

Trajectories of N objects, sampled in time and interpolated between the samples.

Between two samples positions follow the cubic with the given positions and velocities at both ends (Hermite);
velocities and headings are interpolated linearly.

Pedestrians on the pavements, alone and in groups that walk, pause and walk on.

The centre of a group moves along the road: its speed w relaxes with time constant tau to its preferred speed, or to 0
during a pause. Each member has a position in the group and sways about it like a damped spring driven by noise,

    dw = (target - w) / tau dt,      de = u dt,      du = -(omega^2 e + 2 omega u) dt + sqrt(4 omega^3) sigma dW,

which in equilibrium has standard deviation sigma per axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_tools.simulator.road import Road
from saga_fg.numerics import BoolArray, FloatArray, StrArray
from saga_fg.types import Boxes

AT_SAMPLE = 1e-6  # share of a step within which a time is that of a sample


@dataclass(frozen=True, eq=False)
class SimulatedTrajectories:
    """N objects on the ground at T equally spaced times, in world coordinates.

    id, label  (N,)
    size       (N, 3) m
    time       (T,) s
    position   (T, N, 2) m
    velocity   (T, N, 2) m/s
    yaw        (T, N) rad, not wrapped
    present    (T, N) True while the object exists
    """

    id: StrArray
    label: StrArray
    size: FloatArray
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    yaw: FloatArray
    present: BoolArray

    def __len__(self) -> int:
        return len(self.id)

    def at(self, time: float) -> tuple[Boxes, BoolArray]:
        """All N boxes at `time`, on the ground z = 0, and a mask (N,) of those that exist at both samples around it."""
        step = self.time[1] - self.time[0]
        k = int(np.clip(np.floor((time - self.time[0]) / step), 0, len(self.time) - 2))
        u = (time - self.time[k]) / step
        p0, p1, v0, v1 = self.position[k], self.position[k + 1], self.velocity[k], self.velocity[k + 1]
        position = (
            (1 + 2 * u) * (1 - u) ** 2 * p0 + u**2 * (3 - 2 * u) * p1 + step * u * (1 - u) * ((1 - u) * v0 - u * v1)
        )
        boxes = Boxes(
            self.label,
            np.column_stack([position, self.size[:, 2] / 2]),
            self.size,
            (1 - u) * self.yaw[k] + u * self.yaw[k + 1],
            (1 - u) * v0 + u * v1,
        )
        before, after = self.present[k] | (u > 1 - AT_SAMPLE), self.present[k + 1] | (u < AT_SAMPLE)
        return boxes, before & after

    def select(self, rows: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> SimulatedTrajectories:
        """The objects of some rows."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("id", "label", "size")},
            **{name: getattr(self, name)[:, rows] for name in ("position", "velocity", "yaw", "present")},
        )


def concatenated(parts: Sequence[SimulatedTrajectories]) -> SimulatedTrajectories:
    """All objects of `parts`, which share their times."""
    return SimulatedTrajectories(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in ("id", "label", "size")},
        time=parts[0].time,
        **{
            name: np.concatenate([getattr(p, name) for p in parts], axis=1)
            for name in ("position", "velocity", "yaw", "present")
        },
    )


def static_objects(id: StrArray, boxes: Boxes, time: FloatArray) -> SimulatedTrajectories:  # noqa: A002
    """Trajectories of objects that never move."""
    shape = (len(time), len(boxes))
    return SimulatedTrajectories(
        id=id,
        label=boxes.label,
        size=boxes.size,
        time=time,
        position=np.broadcast_to(boxes.position[:, :2], (*shape, 2)),
        velocity=np.zeros((*shape, 2)),
        yaw=np.broadcast_to(boxes.yaw, shape),
        present=np.ones(shape, dtype=np.bool_),
    )


RELAXATION = 0.6  # tau, s
PEDESTRIAN_SWAY = 1.0  # omega, 1/s
SPACING = 0.8  # m between people who walk abreast
GROUP_SIZE = (1, 4)  # fewest and most people in a group
WALKING_SPEED = (1.0, 1.7)  # preferred speed of a group, m/s
PAUSE_INTERVAL, PAUSE_DURATION = 20.0, 4.0  # mean time between pauses of a group, and of a pause, s
JITTER = 0.25  # standard deviation of a person's position within the group, m
BODY = (0.65, 0.65, 1.72)  # length, width, height, m


def simulate_pedestrians(
    road: Road,
    pavements: list[tuple[float, float]],
    window: tuple[float, float],
    time: FloatArray,
    number: tuple[int, int],
    rng: np.random.Generator,
) -> SimulatedTrajectories:
    """Pedestrians on `pavements` (lowest and highest offset d, m) who start at road s within `window`, m.

    number: fewest and most groups
    """
    groups = int(rng.integers(number[0], number[1] + 1)) if pavements else 0
    count = rng.integers(GROUP_SIZE[0], GROUP_SIZE[1] + 1, size=groups)
    group = np.repeat(np.arange(groups), count)
    rank = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    offset = np.stack([-(rank // 2) * SPACING * 1.2, (rank % 2 - 0.5) * SPACING], axis=1)
    offset = offset + rng.uniform(-0.1, 0.1, offset.shape)

    centre = rng.uniform(*window, size=groups)
    low, high = np.array([pavements[k] for k in rng.integers(len(pavements), size=groups)]).reshape(-1, 2).T
    middle = rng.uniform(low, high)
    sense = rng.choice([-1.0, 1.0], size=groups)
    preferred = rng.uniform(*WALKING_SPEED, size=groups)
    pausing = rng.random(groups) < PAUSE_DURATION / (PAUSE_DURATION + PAUSE_INTERVAL)
    speed = np.where(pausing, 0.0, preferred)

    h = float(time[1] - time[0])
    sway = JITTER * rng.standard_normal((len(group), 2))
    swing = PEDESTRIAN_SWAY * JITTER * rng.standard_normal((len(group), 2))
    s, d = np.empty((2, len(time), len(group)))
    vs, vd = np.empty_like(s), np.empty_like(s)
    for k in range(len(time)):
        s[k] = centre[group] + sense[group] * offset[:, 0] + sway[:, 0]
        d[k] = middle[group] + offset[:, 1] + sway[:, 1]
        vs[k] = sense[group] * speed[group] + swing[:, 0]
        vd[k] = swing[:, 1]
        toggle = rng.random(groups) < h / np.where(pausing, PAUSE_DURATION, PAUSE_INTERVAL)
        pausing = pausing ^ toggle
        centre = centre + h * sense * speed
        speed = speed + h / RELAXATION * (np.where(pausing, 0.0, preferred) - speed)
        sway = sway + h * swing
        kick = np.sqrt(4 * PEDESTRIAN_SWAY**3 * h) * JITTER * rng.standard_normal(swing.shape)
        swing = swing - h * (PEDESTRIAN_SWAY**2 * sway + 2 * PEDESTRIAN_SWAY * swing) + kick
    heading = road.heading_at(s)
    stretch = 1 - road.curvature_at(s) * d
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    size = np.array(BODY) * np.exp(0.08 * np.clip(rng.standard_normal((len(group), 3)), -2, 2))
    return SimulatedTrajectories(
        id=np.array([f"pedestrian-{k:03d}" for k in range(len(group))], dtype=np.str_),
        label=np.full(len(group), "pedestrian"),
        size=size,
        time=time,
        position=road.position(s, d),
        velocity=(vs * stretch)[..., None] * tangent + vd[..., None] * normal,
        yaw=heading + np.where(sense[group] > 0, 0.0, np.pi),
        present=np.ones(s.shape, dtype=np.bool_),
    )
