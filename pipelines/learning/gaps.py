"""A tracker's runs through gaps that are made in recordings, judged gap by gap.

Labels and tracks that were detected at the moment are matched one to one (`data_tools.metrics.scene`). An object is
*held* by the track it was matched to last, at most `SETTLING` s ago. That track, which is kept alive while it has no
detections, is compared with the label: its error, m, which is `CAP` where it is not known or farther away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import TypeVar

import numpy as np

from data_tools.metrics.scene import match_scene
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.learning.labelled_scene import LONGEST, Gap, LabelledScene, made_gaps, reached
from saga_fg.numerics import FloatArray
from saga_fg.types import Frame, Scene, Tracks

SETTLING = 0.6  # s: for so long a returning object may wait for its identity
DETECTED = 0.15  # s: a track counts as detected for so long, as sensors don't measure at the moments of labels
CAP = 10.0  # m
GATE = 2.0  # m, between a label and its track
LIFE = LONGEST + 1.0  # s: for so long tracks live without a detection

Errors = Mapping[float, float]
"""Position errors, m, by time since the last detection, s, of one gap."""
A = TypeVar("A")
B = TypeVar("B")


class JudgedRun:
    """A run's tracks (K,) at the moments of a labelled scene.

    track_of  for each moment, the detected track of each object that has one, by its name
    """

    def __init__(self, labelled: LabelledScene, tracks: Sequence[Tracks]) -> None:
        self.labelled, self.tracks = labelled, tracks
        truth = labelled.scene.ground_truth
        assert truth is not None
        self.detected = [found.select(found.coasting <= DETECTED) for found in tracks]
        self.track_of: list[dict[str, int]] = []
        for moment, found, match in zip(truth, self.detected, match_scene(truth, self.detected, GATE), strict=True):
            pairs = (moment.id[match.object_row].tolist(), found.id[match.track_row].tolist())
            self.track_of.append(dict(zip(*pairs, strict=True)))
        self.row_of = [{name: row for row, name in enumerate(found.id.tolist())} for found in tracks]

    def outcome(self, gap: Gap) -> Errors:
        """Judge one gap."""
        ends, holder = reached(self.labelled.scene.timestamps, gap), self.holder(gap)
        if holder is None:
            return dict.fromkeys(ends, CAP)
        errors = {length: self.error(holder, gap.row, k) for length, k in ends.items()}
        return {length: error for length, error in errors.items() if np.isfinite(error)}

    def holder(self, gap: Gap) -> int | None:
        """The track that held the object before the gap."""
        return self.last(self.track_of, str(self.labelled.id[gap.row]), gap.start, back=True)

    def last(self, of: Sequence[Mapping[A, B]], one: A, moment: int, back: bool) -> B | None:
        """The last partner within `SETTLING` s until a moment (`back`), or from it on."""
        after = (self.labelled.scene.timestamps - self.labelled.scene.timestamps[moment]) * (-1 if back else 1)
        near = np.flatnonzero((after >= 0) & (after <= SETTLING))
        return next((of[k][one] for k in near[::-1].tolist() if one in of[k]), None)

    def error(self, track: int, row: int, moment: int) -> float:
        """The error of a track at a moment, NaN where the object is not labelled."""
        truth = self.labelled.position[moment, row]
        if not np.isfinite(truth[0]):
            return float("nan")
        there = self.position(track, moment)
        return CAP if there is None else min(float(np.hypot(*(there - truth))), CAP)

    def position(self, track: int, moment: int) -> FloatArray | None:
        """The place (2,) of a track, None where it is not among the results."""
        row = self.row_of[moment].get(track)
        return None if row is None else np.asarray(self.tracks[moment].boxes.position[row, :2])


@dataclass(frozen=True)
class Contender:
    """A method with its configuration."""

    name: str
    method: Method
    config: TrackConfig

    def kept_alive(self) -> Contender:
        """The contender whose tracks live, and are reported, for as long as any gap."""
        config, own = self.config, self.config.tracker
        tracker = replace(
            own,
            report_coasting=inf,
            report_out_of_view=True,
            max_coasting=LIFE,
            classes={label: replace(each, max_deviation=inf) for label, each in own.classes.items()},
            existence=replace(own.existence, delete_below=0.0, report_above=0.0),
        )
        greedy = replace(config.greedy, max_coasting=LIFE)
        return replace(self, config=replace(config, tracker=tracker, greedy=greedy))


@dataclass(frozen=True)
class Run:
    """A contender's errors in the gaps of one recording, with the class of the object of each gap."""

    recording: str
    contender: str
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    outcomes: tuple[Errors, ...]


def judged_on(
    scenes: Mapping[str, Scene],
    contenders: Sequence[Contender],
    passes: int,
    seed: int,
    progress: Progress | None = None,
) -> list[Run]:
    """Runs of all contenders, whose sensors are the same, on recordings with made gaps, tracks kept alive."""
    runs: list[Run] = []
    for name, scene in scenes.items():
        labelled = LabelledScene.from_scene(scene, contenders[0].config.sensors)
        gaps = made_gaps(labelled, passes, seed)
        for contender in contenders:
            outcomes: dict[int, Errors] = {}
            for number in sorted({gap.run for gap in gaps}):
                mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
                run = JudgedRun(labelled, tracks_without(labelled, list(mine.values()), contender.kept_alive()))
                outcomes |= {k: run.outcome(gap) for k, gap in mine.items()}
            ordered = tuple(outcomes[k] for k in range(len(gaps)))
            runs.append(Run(name, contender.name, tuple(gaps), classes_of(labelled, gaps), ordered))
            if progress is not None:
                progress(f"held out {name} {contender.name}", len(runs), len(scenes) * len(contenders))
    return runs


def classes_of(labelled: LabelledScene, gaps: Sequence[Gap]) -> tuple[str, ...]:
    """The class of the object of each gap."""
    return tuple(str(labelled.label[gap.row]) for gap in gaps)


def tracks_without(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender) -> Sequence[Tracks]:
    """A contender's tracks without the detections of some gaps."""
    scene = replace(labelled.scene, frames=hidden(labelled, gaps) if gaps else labelled.scene.frames)
    return track_scene(scene, contender.config.new_tracker(contender.method)).tracks


def hidden(labelled: LabelledScene, gaps: Sequence[Gap]) -> list[Frame]:
    """The frames without the detections of some gaps."""
    time = labelled.scene.timestamps
    start = np.array([time[gap.start] for gap in gaps])
    stop = np.array([time[gap.stop] for gap in gaps])
    return labelled.frames_without(np.array([gap.row for gap in gaps]), start, stop)
