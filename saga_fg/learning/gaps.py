"""Gaps in recordings, made by taking detections away.

A gap lasts from the last moment with a detection before it to the first moment with one after it. An object *moves* if
it travels faster than `MOVING` over the gap.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.numerics.arrays import BoolArray, FloatArray

MOVING = 0.5  # m/s
LONGEST = 6.0  # s, of all gaps
LENGTHS = (1.0, 2.0, 3.0, 5.0)  # s: made gaps
FOLLOWED, FOLLOWED_SHARE = 1.5, 0.8  # s before a made gap, and the share of its moments with a detection
SPACING = 20.0  # m between objects that are hidden at the same time
STARTS = 0.5  # s between moments at which a made gap may start
TRIALS = 4000  # of a pass: windows that are tried


@dataclass(frozen=True)
class Gap:
    """One object without detections after moment `start`, its last with one, until moment `stop`.

    row       of the object in the `LabelledScene`
    length    s: of a real gap from `start` to `stop`, of a made one as wanted, from `start` to the last moment without
    run       0 for real gaps, the number of the pass for made ones
    """

    row: int
    start: int
    stop: int
    length: float
    moving: bool
    run: int = 0


def reached(time: FloatArray, gap: Gap) -> dict[float, int]:
    """The moments of a gap at which the lengths that it reaches end; time (K,) of all moments."""
    period = float(np.median(np.diff(time)))
    since = time[gap.start + 1 : gap.stop] - time[gap.start]
    found = {}
    for length in LENGTHS if len(since) else ():
        k = int(np.argmin(np.abs(since - length)))
        if abs(since[k] - length) < 0.6 * period:
            found[length] = gap.start + 1 + k
    return found


def made_gaps(
    labelled: LabelledScene,
    passes: int,
    seed: int,
    lengths: Sequence[float] = LENGTHS,
    chosen: Callable[[Gap], bool] | None = None,
) -> list[Gap]:
    """Windows in which objects can be hidden: well followed before, labelled throughout, detected at the end.

    chosen  the windows that count, all if not given

    In one pass an object may be hidden several times; objects that are hidden at the same time are `SPACING` apart.
    """
    time = labelled.scene.timestamps
    if len(time) < 3:
        return []
    rng = np.random.default_rng([seed, zlib.crc32(labelled.scene.name.encode())])
    possible = [gap for gap in windows(labelled, rng, lengths) if chosen is None or chosen(gap)]
    gaps: list[Gap] = []
    for number in range(1, passes + 1):
        order = rng.permutation(len(possible))
        order = order[np.argsort([not possible[k].moving for k in order], kind="stable")]  # these are fewer
        taken = _Taken(labelled)
        for k in order[:TRIALS].tolist():
            if taken.free(possible[k]):
                taken.add(possible[k])
                gaps.append(replace(possible[k], run=number))
    return gaps


def windows(labelled: LabelledScene, rng: np.random.Generator, lengths: Sequence[float]) -> list[Gap]:
    """All gaps that are possible, by row and every `STARTS` s; a length is chosen at random for each."""
    time, found = labelled.scene.timestamps, []
    period = float(np.median(np.diff(time)))
    known = np.isfinite(labelled.position[..., 0])
    until = {length: _ends(time, length) for length in lengths}
    before = np.searchsorted(time, time - FOLLOWED - period / 4)
    stride = max(1, round(STARTS / period))
    counts = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), labelled.detected.cumsum(axis=0)])
    named = np.concatenate([np.zeros((1, len(labelled.id)), dtype=np.int64), known.cumsum(axis=0)])
    for start in range(int(rng.integers(stride)), len(time), stride):
        if time[start] - time[0] < FOLLOWED - period / 2:
            continue
        first = int(before[start])
        hits = counts[start + 1] - counts[first]
        followed = labelled.detected[start] & (hits >= FOLLOWED_SHARE * (start + 1 - first))
        possible: dict[int, list[tuple[float, int]]] = {}
        for length in lengths:
            stop = int(until[length][start]) + 1
            if stop < len(time) and abs(time[stop - 1] - time[start] - length) < 0.6 * period:
                whole = named[stop + 1] - named[start] == stop + 1 - start
                for row in np.flatnonzero(followed & whole & labelled.detected[stop]).tolist():
                    possible.setdefault(row, []).append((length, stop))
        for row, choices in possible.items():
            length, stop = choices[int(rng.integers(len(choices)))]
            found.append(Gap(row, start, stop, length, is_moving(labelled, row, start, stop)))
    return found


def _ends(time: FloatArray, length: float) -> FloatArray:
    """(K,) the moment nearest to `length` s after each."""
    after = np.clip(np.searchsorted(time, time + length), 1, len(time) - 1)
    nearer = np.abs(time[after - 1] - time - length) < np.abs(time[after] - time - length)
    return np.asarray(after - nearer)


class _Taken:
    """The windows of one pass."""

    def __init__(self, labelled: LabelledScene) -> None:
        self._labelled = labelled
        self._windows: list[tuple[int, int, int]] = []

    def add(self, gap: Gap) -> None:
        self._windows.append((gap.row, gap.start, gap.stop))

    def free(self, gap: Gap) -> bool:
        """Return True if no window of the object, or of one near it, is in the way."""
        if not self._windows:
            return True
        time, position = self._labelled.scene.timestamps, self._labelled.position
        row, start, stop = np.array(self._windows).T
        apart = np.maximum(time[start] - time[gap.stop], time[gap.start] - time[stop])
        if (apart[row == gap.row] < FOLLOWED).any():
            return False
        near: BoolArray = np.zeros(len(row), dtype=np.bool_)
        for at in (np.maximum(start, gap.start), np.minimum(stop, gap.stop)):
            at = np.clip(at, gap.start, gap.stop)
            offset = position[at, row] - position[at, gap.row]
            near |= ~(np.hypot(offset[:, 0], offset[:, 1]) >= SPACING)
        return not ((apart < FOLLOWED) & (row != gap.row) & near).any()


def is_moving(labelled: LabelledScene, row: int, start: int, stop: int) -> bool:
    a, b = labelled.position[[start, stop], row]
    elapsed = float(labelled.scene.timestamps[stop] - labelled.scene.timestamps[start])
    return bool(np.hypot(*(b - a)) > MOVING * elapsed)
