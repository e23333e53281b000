"""What matching costs: each way of it on the same drawn scenes, as a ratio to the Hungarian algorithm's time.

Times are those of the whole stage, the reading of covariances included, per frame, in CPU time of the thread; the
methods take turns frame by frame. Groups are hidden now and then, so that there is something to decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.drawn_scenes import DrawnSettings, drawn_config, drawn_scene
from data_tools.metrics import scene_metrics
from pipelines.observers import StageClock
from pipelines.process import one_thread
from pipelines.tracking import Progress
from saga_fg.tracking import AssociationName
from saga_fg.types.track import Tracks

METHODS: tuple[AssociationName, ...] = ("hungarian", "greedy", "graph")
BASELINE = METHODS[0]
MEMBERS = 5  # of a group


@dataclass(frozen=True)
class AssociationRow:
    """Milliseconds a frame of the stage and of the whole tracker, and identity switches, of one method."""

    objects: int
    method: AssociationName
    milliseconds: float
    ratio: float
    whole_milliseconds: float
    switches: int


def bench_association(
    sizes: Sequence[int], seconds: float = 10.0, seed: int = 0, progress: Progress | None = None
) -> tuple[AssociationRow, ...]:
    """One row for every method on about so many objects, in groups of five."""
    rows = []
    for done, objects in enumerate(sizes):
        rows += _of_size(max(objects // MEMBERS, 1), seconds, seed)
        if progress is not None:
            progress(f"{objects} objects", done + 1, len(sizes))
    return tuple(rows)


def _of_size(groups: int, seconds: float, seed: int) -> list[AssociationRow]:
    settings = DrawnSettings(groups=groups, members=MEMBERS, clutter=groups / 4, seconds=seconds)
    scene, config = drawn_scene(settings, seed), drawn_config(settings)
    assert scene.ground_truth is not None
    clocks = {method: StageClock() for method in METHODS}
    trackers = {method: config.with_association(method).new_tracker("saga", clocks[method]) for method in METHODS}
    tracks: dict[AssociationName, list[Tracks]] = {method: [] for method in METHODS}
    with one_thread():
        for frame in scene.frames:
            for method, tracker in trackers.items():
                clocks[method].start()
                tracks[method].append(tracker.step(frame))
    spent = {method: 1e3 * clocks[method].seconds["associate"] / len(scene.frames) for method in METHODS}
    return [
        AssociationRow(
            groups * MEMBERS,
            method,
            spent[method],
            spent[method] / spent[BASELINE],
            1e3 * sum(clocks[method].seconds.values()) / len(scene.frames),
            scene_metrics(scene.ground_truth, tracks[method]).switches,
        )
        for method in METHODS
    ]
