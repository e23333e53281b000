"""Recordings with made gaps as recordings of their own, for the tracking benchmark.

Windows of recorded traffic are short, and an object seldom returns in one. In each pass objects have no detections for
1, 2, 3 or 5 s, as in the benchmark of gaps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from benchmarks.recordings import ChosenRecordings, RecordingSet, TrueSet
from pipelines.learning.gap_runs import hidden
from saga_fg.errors import InputError
from saga_fg.learning.gaps import LENGTHS, made_gaps
from saga_fg.learning.labelled_scene import LabelledScene
from saga_fg.model.sensor import Sensor
from saga_fg.types.dataset import Dataset, Scene


class HiddenRecordings:
    """Each scene of a dataset in several passes, with other gaps in each."""

    def __init__(self, dataset: Dataset, sensors: Mapping[str, Sensor], passes: int, lengths: Sequence[float]) -> None:
        self._dataset, self._sensors, self._passes, self._lengths = dataset, sensors, passes, lengths
        every = ((name, k) for name in dataset.scenes for k in range(1, passes + 1))
        self.pass_of = {f"{name}, pass {k}": (name, k) for name, k in every}

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the recordings with the numbers of the passes."""
        return tuple(self.pass_of)

    def scene(self, name: str) -> Scene:
        """One pass; its name is that of the recording."""
        recording, number = self.pass_of[name]
        labelled = LabelledScene.of(self._dataset.scene(recording), self._sensors)
        gaps = [gap for gap in made_gaps(labelled, self._passes, 0, self._lengths) if gap.run == number]
        return replace(labelled.scene, frames=hidden(labelled, gaps))


def with_made_gaps(
    recordings: RecordingSet, sensors: Mapping[str, Sensor], passes: int, lengths: Sequence[float] = LENGTHS
) -> RecordingSet:
    """The set in several passes, each with made gaps of some lengths, s; those of one recording are one for intervals.

    Raises `InputError` for a set whose truth is not known at every frame.
    """
    whole = recordings.whole if isinstance(recordings, ChosenRecordings) else recordings
    if not isinstance(whole, TrueSet):
        raise InputError(f"--passes: set {whole.name}: expected simulated or recorded traffic, whose truth is exact")
    dataset = HiddenRecordings(recordings.dataset, sensors, passes, lengths)
    clusters = {name: whole.clusters.get(of, of) for name, (of, _) in dataset.pass_of.items()}
    return TrueSet(whole.name, whole.family, dataset, clusters)
