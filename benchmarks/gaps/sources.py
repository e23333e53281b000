"""Recordings for the benchmark of gaps: sets with a detector's results, and data sets that have annotations alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

from benchmarks.recordings import SETS, TRAFFIC_SETS, RecordingSet, TrueSet, recording_set
from data_tools.datasets.annotated import detected
from data_tools.datasets.registry import dataset_source
from data_tools.simulator.recorded_world import ABOVE
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene

ANNOTATED = {"argoverse2": "av2", "eth_ucy": "eth_ucy"}
"""Data sets whose detections are their visible annotations, and their folders in that of --data."""
KNOWN = (*SETS, "simulated", *TRAFFIC_SETS, *ANNOTATED)
"""All sets."""


@dataclass(frozen=True)
class RecordingSource:
    """A set by name. Picklable.

    data    folder of all recordings; scenes: number of simulated ones
    labels  whether the visible annotations take the place of the detector's results
    viewpoint  of the sensors that see recorded traffic, see `data_tools.simulator.recorded_world`
    longest  of recorded traffic, s, from the middle of longer recordings
    """

    name: str
    data: Path | None = None
    scenes: int = 10
    labels: bool = False
    viewpoint: str = ABOVE
    longest: float = inf

    @contextmanager
    def opened(self) -> Iterator[Dataset]:
        """The recordings, with ground truth. Raises `InputError` for an unknown set or missing recordings."""
        if self.name not in ANNOTATED:
            yield self._set.dataset
            return
        if self.data is None:
            raise InputError(f"set {self.name}: expected --data DIR with {ANNOTATED[self.name]}/")
        options: dict[str, Any] = {"dataroot": str(self.data / ANNOTATED[self.name])}
        with dataset_source(self.name)(**options).open(truth=True) as dataset:
            yield dataset

    @property
    def family(self) -> str | Path:
        """The kind of settings that fit."""
        if self.name in ANNOTATED:
            return dataset_source(self.name).family
        return self._set.family

    @property
    def complete(self) -> bool:
        """True where nothing is hidden, so that there are no gaps but made ones."""
        return self.name in TRAFFIC_SETS and self.viewpoint == ABOVE

    @property
    def clusters(self) -> Mapping[str, str]:
        """The first of the recordings that overlap in time with each, by name; empty where none can."""
        found = self._set if self.name in TRAFFIC_SETS else None
        return found.clusters if isinstance(found, TrueSet) else {}

    def places(self, recordings: Sequence[str]) -> Mapping[str, str]:
        """The site or setting of each recording of traffic; of other sets, each is a place of its own."""
        return {name: name.partition("-")[0] for name in recordings} if self.name in TRAFFIC_SETS else {}

    @property
    def _set(self) -> RecordingSet:
        return _set(self.name, self.data, self.scenes, self.viewpoint, self.longest)

    def scene(self, recording: str) -> Scene:
        """Read a recording."""
        with self.opened() as dataset:
            scene = dataset.scene(recording)
        return replace(scene, frames=detected(scene)) if self.labels else scene


@lru_cache(maxsize=4)
def _set(name: str, data: Path | None, scenes: int, viewpoint: str, longest: float) -> RecordingSet:
    """Files of detections are read once."""
    return recording_set(name, data, scenes, viewpoint, longest)


def set_names(data: Path | None) -> tuple[str, ...]:
    """The sets that can be had by default."""
    return (*SETS, "simulated") if data is not None else ("simulated",)
