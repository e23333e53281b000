"""Runs through gaps: every contender tracks every recording, with all detections and with some taken away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from math import inf
from typing import Literal, Protocol

import numpy as np

from pipelines.config import Method, TrackConfig
from pipelines.learning.gap_judging import GapOutcome, JudgedRun, Links
from pipelines.tracking import Progress, track_scene
from saga_fg.learning.gaps import LENGTHS, LONGEST, Gap, made_gaps, real_gaps
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.learning.situations import situations_of
from saga_fg.model.sensor import Sensor
from saga_fg.types.dataset import Scene
from saga_fg.types.frame import Frame

Life = Literal["kept", "shipped"]
LIVES: tuple[Life, ...] = ("kept", "shipped")
LIFE = LONGEST + 1.0  # s: for so long tracks that are kept alive live without a detection


def with_life(config: TrackConfig, life: Life) -> TrackConfig:
    """The configuration, with tracks that live, and are reported, for as long as any gap if they are kept alive."""
    if life == "shipped":
        return config
    own = config.tracker
    tracker = replace(
        own,
        report_coasting=inf,
        max_coasting=LIFE,
        max_out_of_view=inf,
        classes={label: replace(each, max_deviation=inf) for label, each in own.classes.items()},
        existence=replace(own.existence, delete_below=0.0, report_above=0.0),
    )
    return replace(config, tracker=tracker, greedy=replace(config.greedy, max_coasting=LIFE))


class SceneSource(Protocol):
    """Recordings by name, with ground truth and detections."""

    @property
    def name(self) -> str: ...

    @property
    def clusters(self) -> Mapping[str, str]:
        """The first of the recordings that overlap in time with each, by name; empty where none can."""
        ...

    def scene(self, recording: str) -> Scene:
        """Read a recording."""
        ...


@dataclass(frozen=True)
class GapBenchSettings:
    """Passes over each recording with made gaps, the lives compared, lengths of made gaps, s, seed of their choice.

    real  whether the gaps of the recordings themselves are judged too, and the links
    of    situations, one of which objects are in at the end of made gaps (`saga_fg.learning.situations`); none: any
    """

    passes: int = 2
    lives: tuple[Life, ...] = LIVES
    lengths: tuple[float, ...] = LENGTHS
    seed: int = 0
    real: bool = True
    of: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contender:
    """A method with its configuration."""

    name: str
    method: Method
    config: TrackConfig


@dataclass(frozen=True)
class Run:
    """A contender's outcomes in the gaps of one recording, and its links in the run without made gaps.

    links       None of a contender that does not track, and without real gaps
    cluster     the first of the recordings that overlap with this one, or itself
    situations  of the object of each gap, by the length until which; none for real gaps
    """

    recording: str
    cluster: str
    contender: str
    life: Life
    gaps: tuple[Gap, ...]
    label: tuple[str, ...]
    situations: tuple[Mapping[float, frozenset[str]], ...]
    outcomes: tuple[GapOutcome, ...]
    links: Links | None


def bench_gaps(
    source: SceneSource,
    recordings: Sequence[str],
    contenders: Sequence[Contender],
    settings: GapBenchSettings,
    progress: Progress | None = None,
) -> list[Run]:
    """All runs on some recordings of a set."""
    cluster, runs, jobs = source.clusters, list[Run](), list(product(recordings, contenders))
    for done, (name, contender) in enumerate(jobs):
        labelled, gaps = prepared(source, name, settings, contender.config.sensors)
        for life in settings.lives:
            run = run_of(labelled, gaps, contender, life, settings.real)
            runs.append(replace(run, cluster=cluster.get(name, name)))
        if progress is not None:
            progress(f"{source.name} {name} {contender.name}", done + 1, len(jobs))
    return runs


@dataclass(frozen=True)
class _Preparation:
    """Everything that the gaps of a recording depend on; sensors place detections alike for all contenders."""

    source: SceneSource
    recording: str
    settings: GapBenchSettings
    sensors: Mapping[str, Sensor] = field(compare=False)


def prepared(
    source: SceneSource, recording: str, settings: GapBenchSettings, sensors: Mapping[str, Sensor]
) -> tuple[LabelledScene, list[Gap]]:
    """A recording and its gaps; the latest one is kept, for the next contender."""
    return _prepared(_Preparation(source, recording, settings, sensors))


@lru_cache(maxsize=1)
def _prepared(of: _Preparation) -> tuple[LabelledScene, list[Gap]]:
    labelled, settings = LabelledScene.of(of.source.scene(of.recording), of.sensors), of.settings
    real = real_gaps(labelled) if settings.real else []

    def wanted(gap: Gap) -> bool:
        return not situations_of(labelled, gap).get(gap.length, frozenset()).isdisjoint(settings.of)

    chosen = wanted if settings.of else None
    return labelled, [*real, *made_gaps(labelled, settings.passes, settings.seed, settings.lengths, chosen)]


def run_of(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life, real: bool = True) -> Run:
    """Track without the detections of each pass, and before, for `real` gaps and links, with all; judge."""
    outcomes: dict[int, GapOutcome] = {}
    links = Links() if real else None
    for number in sorted({*([0] if real else []), *(gap.run for gap in gaps)}):
        mine = {k: gap for k, gap in enumerate(gaps) if gap.run == number}
        judged = judged_run(labelled, list(mine.values()), contender, life)
        outcomes |= {k: judged.outcome(gap) for k, gap in mine.items()}
        if number == 0:
            links = judged.links()
    label = tuple(str(labelled.label[gap.row]) for gap in gaps)
    ordered = tuple(outcomes[k] for k in range(len(gaps)))
    situations = tuple(situations_of(labelled, gap) if gap.run > 0 else {} for gap in gaps)
    name = labelled.scene.name
    return Run(name, name, contender.name, life, tuple(gaps), label, situations, ordered, links)


def judged_run(labelled: LabelledScene, gaps: Sequence[Gap], contender: Contender, life: Life) -> JudgedRun:
    """Track without the detections of the made ones among the gaps of one run."""
    scene, config = labelled.scene, with_life(contender.config, life)
    made = [gap for gap in gaps if gap.run > 0]
    frames = hidden(labelled, made) if made else scene.frames
    tracks = track_scene(replace(scene, frames=frames), config.new_tracker(contender.method)).tracks
    return JudgedRun(labelled, tracks, extrapolated=contender.method == "centerpoint")


def hidden(labelled: LabelledScene, gaps: Sequence[Gap]) -> list[Frame]:
    """The frames without the detections of some gaps."""
    time = labelled.scene.timestamps
    start = np.array([time[gap.start] for gap in gaps])
    stop = np.array([time[gap.stop] for gap in gaps])
    return labelled.frames_without(np.array([gap.row for gap in gaps]), start, stop)
