"""Where is the part of a coupled pair that nobody sees while the other stays in view?

From time to time all detections of one part of every pair (trailers, riders), and next time of the other (trucks,
bicycles), are taken out of the frames for a while. At its end the track that was the part's at its beginning is
compared with where the part is. Asked about are pairs of which both were in view before, and one throughout, and that
move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.predictions import FOLLOWED, Asked, fed, in_view, moving, own_tracks, position_errors
from data_tools.simulator.world import World
from pipelines.process import one_thread
from pipelines.tracking import OnlineTracker
from saga_fg.numerics.arrays import StrArray
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

HIDDEN = 2.0  # s
EVERY = 3.5  # s from one time of hiding to the next
OWN = {"trailer": 3.0, "vehicle": 3.0, "rider": 1.2, "bicycle": 1.2}  # m from the part: its own detections
COUPLED = {"towing": ("trailer", "vehicle"), "cycling": ("rider", "bicycle")}
"""By kind of scene, what the ids of the two parts of a pair begin with; the number that follows is the same."""


@dataclass(frozen=True, eq=False)
class Hiding:
    """`parts` are hidden from the moment `start` of a scene to the moment `end` (rows); `asked`: those of interest."""

    start: int
    end: int
    parts: StrArray
    asked: StrArray


def hidings(scene: Scene, pair: tuple[str, str]) -> list[Hiding]:
    """Who is hidden when: the one and the other part of all pairs in turn."""
    assert scene.ground_truth is not None
    step = float(np.median(np.diff(scene.timestamps)))
    before, hidden, every = (round(time / step) for time in (FOLLOWED, HIDDEN, EVERY))
    found = []
    for turn, start in enumerate(range(before, len(scene) - hidden, every)):
        own, other = pair if turn % 2 == 0 else pair[::-1]
        moments = scene.ground_truth[start - before : start + hidden + 1]
        now = moments[before]
        coupled, seen, partners = _numbers(now.id, own), in_view(moments[: before + 1]), in_view(moments)
        asked = _numbers(seen, own) & _numbers(partners, other) & _numbers(moving(now), own)
        parts = coupled & _numbers(now.id, other)
        found.append(Hiding(start, start + hidden, *(_named(own, numbers) for numbers in (parts, asked))))
    return found


def _numbers(ids: StrArray, kind: str) -> set[str]:
    """The numbers of the ids that begin with `kind`."""
    return {name.partition("-")[2] for name in ids.tolist() if name.startswith(f"{kind}-")}


def _named(kind: str, numbers: set[str]) -> StrArray:
    return np.array([f"{kind}-{number}" for number in sorted(numbers)], dtype=np.str_)


def without_parts(scene: Scene, world: World, times: Sequence[Hiding]) -> tuple[Frame, ...]:
    """The frames without the detections of the hidden parts."""
    offset = float(scene.timestamps[0]) - world.start
    frames = list(scene.frames)
    for hiding in times:
        rows = np.flatnonzero(np.isin(world.objects.id, hiding.parts))
        reach = np.array([OWN[str(name).partition("-")[0]] for name in world.objects.id[rows]])
        for k, frame in enumerate(frames):
            if scene.timestamps[hiding.start] < frame.timestamp <= scene.timestamps[hiding.end] and len(rows):
                truth = world.objects.at(frame.timestamp - offset)[0].select(rows)
                seen = frame.detections.boxes
                apart = seen.position[:, None, :2] - truth.position[:, :2]
                own = (np.hypot(*np.moveaxis(apart, -1, 0)) < reach) & (seen.label[:, None] == truth.label)
                frames[k] = replace(frame, detections=frame.detections.select(np.flatnonzero(~own.any(axis=1))))
    return tuple(frames)


def hidden_errors(
    scene: Scene, frames: Sequence[Frame], tracker: OnlineTracker, times: Sequence[Hiding]
) -> Mapping[Asked, float]:
    """Errors, m, of the positions of hidden parts at the end of their hiding, by id and row of the moment."""
    assert scene.ground_truth is not None
    errors: dict[Asked, float] = {}
    done = 0
    with one_thread():
        for hiding in times:
            now, then = scene.ground_truth[hiding.start], scene.ground_truth[hiding.end]
            asked = np.isin(now.id, hiding.asked)
            begin, end = (float(scene.timestamps[row]) for row in (hiding.start, hiding.end))
            done = fed(tracker, frames, done, begin)
            own = own_tracks(tracker.tracks(begin), now.boxes.select(asked))
            done = fed(tracker, frames, done, end)
            found = position_errors(tracker.tracks(end), own, then, now.id[asked])
            errors |= {(name, hiding.end): error for name, error in found.items()}
    return errors
