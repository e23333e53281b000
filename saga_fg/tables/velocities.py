"""Velocities of detections: those between frames, and measured ones that contradict them."""

from itertools import pairwise

import numpy as np

from saga_fg.numerics import FloatArray, StrArray
from saga_fg.tables.plausibility import FEWEST, share
from saga_fg.types import Finding, Mend

MAX_FRAMES = 200
MIN_STEP = 1e-6  # s between two frames, of which a velocity can be told
SPAN = 0.5  # s of motion, so that the noise of places hardly matters
MOVES, WALKS = 2.0, 0.8  # m/s, from which the direction of motion tells the heading, of vehicles and of people
ALIKE = 0.8  # m/s between motions that may be the same


def rotated(vectors: FloatArray, yaw: FloatArray) -> FloatArray:
    """Vectors (n, 2), rotated by angles (n,), rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]])


def velocities_between_frames(time: FloatArray, label: StrArray, position: FloatArray) -> FloatArray:
    """Velocities (n, 2) of detections at times (n,), s, and places (n, 2) in the world; NaN where they are not clear.

    That of a detection is over half a second and more, from frame to frame to the nearest of its class, if it is the
    nearest of that in turn, and the second nearest is twice as far.
    """
    from scipy.spatial import cKDTree

    following = np.full(len(time), -1)
    known = np.isfinite(time) & np.isfinite(position).all(axis=1)
    for name in np.unique(label).tolist():
        mine = np.flatnonzero((label == name) & known)
        moments = np.unique(time[mine])[: MAX_FRAMES + 1]
        frames = [mine[time[mine] == moment] for moment in moments]
        for now, later in pairwise(frames):
            distance, nearest = cKDTree(position[later]).query(position[now], k=2)
            _, back = cKDTree(position[now]).query(position[later])
            clear = (back[nearest[:, 0]] == np.arange(len(now))) & (distance[:, 1] > 2 * distance[:, 0])
            clear &= time[later[0]] - time[now[0]] > MIN_STEP
            following[now[clear]] = later[nearest[clear, 0]]
    reached, found = np.arange(len(time)), np.full(position.shape, np.nan)
    for _ in range(MAX_FRAMES):
        short = time[reached] - time < SPAN - MIN_STEP
        short &= following[reached] >= 0
        if not short.any():
            break
        reached[short] = following[reached[short]]
    took = time[reached] - time
    rows = np.flatnonzero((took >= SPAN - MIN_STEP) & known)
    found[rows] = (position[reached[rows]] - position[rows]) / took[rows, None]
    return found


def shared_motion(time: FloatArray, motion: FloatArray) -> FloatArray:
    """The motion (n, 2) that most objects share in the second of each row, by motions (n, 2); NaN where unknown.

    It is where frames, at times (n,), s, have three objects and more.
    """
    shared, known = np.full(motion.shape, np.nan), np.isfinite(motion).all(axis=1)
    second = np.floor(time)
    for now in np.unique(second[known]).tolist():
        rows = np.flatnonzero(known & (second == now))[:MAX_FRAMES]
        if len(rows) < 3 * len(np.unique(time[rows])):
            continue
        near = np.hypot(*(motion[rows, None] - motion[None, rows]).transpose(2, 0, 1)) < ALIKE
        shared[second == now] = motion[rows[near[near.sum(axis=1).argmax()]]].mean(axis=0)
    return shared


_STILL = 0.5  # m/s between frames, below which an object may stand
_SPEEDS = {"km/h": 3.6, "ft/s": 3.281, "mph": 2.237}
_WITHOUT = Mend(columns={"vx": "", "vy": ""})


def velocities_against_motion(
    velocity: FloatArray, motion: FloatArray, ego: FloatArray | None = None, axes: FloatArray | None = None
) -> Finding | None:
    """Measured velocities (n, 2) which are those between frames (n, 2) in another unit or sense, or are none.

    ego   (n, 2) velocity of the vehicle over ground, to which they may be relative
    axes  (n,) turn of the axes along which they may be instead, rad
    """
    known = np.isfinite(motion).all(axis=1) & np.isfinite(velocity).all(axis=1)
    if known.sum() < 2 * FEWEST:
        return None
    velocity, motion, squares = velocity[known], motion[known], (velocity[known] ** 2).sum(axis=1)
    clear = np.hypot(*motion.T) > MOVES
    if clear.sum() >= 2 * FEWEST and share(squares[clear] < 1e-18) > 0.9:
        what = "measured velocities are zero of objects that move"
        return Finding("speeds", what, "expected those over ground, or none", _WITHOUT)
    moves = clear | (squares > (2 * WALKS) ** 2)
    if moves.sum() < 2 * FEWEST:
        return None
    meant = {
        "are exchanged": (velocity[:, ::-1], Mend(columns={"vx": "vy", "vy": "vx"})),
        "are reversed": (-velocity, _WITHOUT),
        "are mirrored": (velocity * [1.0, -1.0], _WITHOUT),
    }
    if ego is not None:
        meant["are relative to the vehicle"] = velocity + ego[known], _WITHOUT
    if axes is not None:
        meant["are along other axes than positions"] = rotated(velocity, axes[known]), _WITHOUT
    apart = {name: _middle_distance(each[moves], motion[moves]) for name, (each, _) in meant.items()}
    least = min(apart.values())
    scaled = min(_middle_distance(velocity[moves] * k, motion[moves]) for f in _SPEEDS.values() for k in (f, 1 / f))
    now, usual = (_middle_distance(each[moves], motion[moves]) for each in (velocity, 0 * motion))
    if now > max(1.0, 0.3 * usual) and least < 0.35 * now and least + 0.1 < scaled:
        name = next(name for name in meant if apart[name] < least + 0.1)
        what = f"measured velocities vx, vy look as if they {name}: half of them differ from the motion between frames"
        return Finding("speeds", f"{what} by {now:.2g} m/s and more", "expected those over ground", meant[name][1])
    return _speeds_in_another_unit(velocity, motion, squares)


def _middle_distance(a: FloatArray, b: FloatArray) -> float:
    apart = np.hypot(*(a - b).T)
    return float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).mean() > 0.5 else np.inf


def _speeds_in_another_unit(velocity: FloatArray, motion: FloatArray, squares: FloatArray) -> Finding | None:
    """Velocities (n, 2) as large as those between frames (n, 2) in another unit than m/s, or those divided by one.

    Fast objects tell the factor. Where all are slow, the mean squares of all velocities v do, less the noise of those
    that stay where they are: f = sum(|v|^2 - noise) / sum(v m), with m between frames.
    """
    products, ways = (velocity * motion).sum(axis=1), (motion**2).sum(axis=1)
    fast, clear = squares > (2 * WALKS) ** 2, ways > MOVES**2
    found: list[tuple[float, list[str]]] = []
    if fast.sum() >= 2 * FEWEST:
        found.append((1 / max(_weighted_median(products[fast] / squares[fast], squares[fast]), 1e-3), list(_SPEEDS)))
        still = np.sqrt(ways) < _STILL
        if still.sum() >= FEWEST:
            noise = np.median(squares[still]) / np.log(2)
            found.append((max((squares - noise).sum() / max(products.sum(), 1e-3), 1e-3), ["km/h", "mph"]))
    for factor, units in found:  # the second is too rough for more units
        unit = min(units, key=lambda unit: abs(np.log(factor / _SPEEDS[unit])))
        if 0.85 < factor / _SPEEDS[unit] < 1.15:
            what = f"measured velocities are {factor:.2g} times as large as objects move from frame to frame"
            return Finding("speeds", f"{what}: they look like {unit}", "expected m/s", Mend(units={"speed": unit}))
    if clear.sum() < 2 * FEWEST:
        return None
    ratio = products[clear] / ways[clear]
    factor = _weighted_median(ratio, ways[clear])
    unit = min(_SPEEDS, key=lambda unit: abs(np.log(max(factor, 1e-3) * _SPEEDS[unit])))
    if not 0.92 < factor * _SPEEDS[unit] < 1.08 or share(np.abs(ratio - factor) < 0.3 * factor) < 0.6:
        return None
    what = f"measured velocities vx, vy are {factor:.2g} times as large as objects move from frame to frame"
    what += f": they look like m/s taken for {unit}, or divided twice"
    return Finding("speeds", what, "expected m/s", Mend(units={"speed": "m/s"}))


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    return float(values[order[np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())]])
