"""Pedestrians on the pavements, alone and in groups that walk, pause and walk on.

The centre of a group moves along the road: its speed w relaxes with time constant tau to its preferred speed, or to 0
during a pause. Each member has a position in the group and sways about it like a damped spring driven by noise,

    dw = (target - w) / tau dt,      de = u dt,      du = -(omega^2 e + 2 omega u) dt + sqrt(4 omega^3) sigma dW,

which in equilibrium has standard deviation sigma per axis.
"""

from __future__ import annotations

import numpy as np

from data_tools.simulator.road import Road
from data_tools.simulator.settings import PedestrianSettings
from data_tools.simulator.trajectories import SimulatedTrajectories
from saga_fg.numerics.arrays import FloatArray

RELAXATION = 0.6  # tau, s
SWAY = 1.0  # omega, 1/s
SPACING = 0.8  # m between people who walk abreast
BODY = (0.65, 0.65, 1.72)  # length, width, height, m


def simulate_pedestrians(
    road: Road,
    pavements: list[tuple[float, float]],
    window: tuple[float, float],
    time: FloatArray,
    settings: PedestrianSettings,
    rng: np.random.Generator,
) -> SimulatedTrajectories:
    """Pedestrians on `pavements` (lowest and highest offset d, m) who start at road s within `window`, m."""
    groups = int(rng.integers(settings.groups[0], settings.groups[1] + 1)) if pavements else 0
    count = rng.integers(settings.group_size[0], settings.group_size[1] + 1, size=groups)
    group = np.repeat(np.arange(groups), count)
    rank = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    offset = np.stack([-(rank // 2) * SPACING * 1.2, (rank % 2 - 0.5) * SPACING], axis=1)
    offset = offset + rng.uniform(-0.1, 0.1, offset.shape)

    centre = rng.uniform(*window, size=groups)
    low, high = np.array([pavements[k] for k in rng.integers(len(pavements), size=groups)]).reshape(-1, 2).T
    middle = rng.uniform(low, high)
    sense = rng.choice([-1.0, 1.0], size=groups)
    preferred = rng.uniform(*settings.walking_speed, size=groups)
    pausing = rng.random(groups) < settings.pause_duration / (settings.pause_duration + settings.pause_interval)
    speed = np.where(pausing, 0.0, preferred)

    h = float(time[1] - time[0])
    sway = settings.jitter * rng.standard_normal((len(group), 2))
    swing = SWAY * settings.jitter * rng.standard_normal((len(group), 2))
    s, d = np.empty((2, len(time), len(group)))
    vs, vd = np.empty_like(s), np.empty_like(s)
    for k in range(len(time)):
        s[k] = centre[group] + sense[group] * offset[:, 0] + sway[:, 0]
        d[k] = middle[group] + offset[:, 1] + sway[:, 1]
        vs[k] = sense[group] * speed[group] + swing[:, 0]
        vd[k] = swing[:, 1]
        toggle = rng.random(groups) < h / np.where(pausing, settings.pause_duration, settings.pause_interval)
        pausing = pausing ^ toggle
        centre = centre + h * sense * speed
        speed = speed + h / RELAXATION * (np.where(pausing, 0.0, preferred) - speed)
        sway = sway + h * swing
        kick = np.sqrt(4 * SWAY**3 * h) * settings.jitter * rng.standard_normal(swing.shape)
        swing = swing - h * (SWAY**2 * sway + 2 * SWAY * swing) + kick
    heading = road.heading_at(s)
    stretch = 1 - road.curvature_at(s) * d
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    size = np.array(BODY) * np.exp(0.08 * np.clip(rng.standard_normal((len(group), 3)), -2, 2))
    return SimulatedTrajectories(
        np.array([f"pedestrian-{k:03d}" for k in range(len(group))], dtype=np.str_),
        np.full(len(group), "pedestrian"),
        size,
        time,
        road.position(s, d),
        (vs * stretch)[..., None] * tangent + vd[..., None] * normal,
        heading + np.where(sense[group] > 0, 0.0, np.pi),
        np.ones(s.shape, dtype=np.bool_),
    )
