"""Tracking and smoothing as tasks for many recordings, with the results in the dataset's own format."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from data_tools.datasets.source import DatasetSource
from pipelines.config import Method, TrackConfig
from pipelines.configuration import write_settings
from pipelines.scale_out.manifest import file_name
from pipelines.smoothing import SmoothConfig, smooth_dataset
from pipelines.tracking import TrackedScene, keep_predictions, track_dataset
from saga_fg.numerics.arrays import FloatArray
from saga_fg.smoothing import LabelCounts
from saga_fg.types.dataset import Dataset

_OF_CLASS = "tracks of "


@dataclass(frozen=True)
class TrackTask:
    """Track the scenes of a part; results in tracks/, as the dataset writes them.

    horizons  (H,) s, to which the tracks of every moment are predicted; None for no predictions
    """

    settings: TrackConfig
    method: Method
    source: DatasetSource
    horizons: FloatArray | None = None

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        ahead = "" if self.horizons is None else f", predicted by {self.horizons.tolist()} s"
        head = f"# track, method {self.method}, results of {self.source.name} as {self.source.tracks_suffix}{ahead}\n"
        head += _reading(self.source)
        return head + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the tracks; counts frames, boxes and tracks, these also by class."""
        counts = dict.fromkeys(("frames", "tracks", "boxes"), 0)
        tracked = track_dataset(dataset, lambda: self.settings.new_tracker(self.method), horizons=self.horizons)
        runs, part = _counted(tracked, counts), folder / "tracks" / f"{file_name(name)}{self.source.tracks_suffix}"
        part.parent.mkdir()
        with keep_predictions(runs, part, self.horizons is not None) as kept:
            self.source.write_track_part(folder, file_name(name), dataset, ((run.scene, run.tracks) for run in kept))
        return counts

    @staticmethod
    def classes(counts: Mapping[str, int]) -> tuple[str, ...]:
        """The classes of the tracks that were counted."""
        return tuple(name.removeprefix(_OF_CLASS) for name in counts if name.startswith(_OF_CLASS))


@dataclass(frozen=True)
class SmoothTask:
    """Label the scenes of a part: labels/NAME with a suffix .csv, .ndjson or .parquet, and what the dataset writes."""

    settings: SmoothConfig
    method: Method
    source: DatasetSource
    suffix: str = ".csv"

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        head = f"# smooth, method {self.method}, results of {self.source.name}, table as {self.suffix}\n"
        head += _reading(self.source)
        return head + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the labels; counts objects, and boxes by where they come from."""
        from data_tools.datasets.label_table import write_label_table

        runs = tuple(smooth_dataset(dataset, self.settings, self.method))
        labels = [(run.scene, run.labels) for run in runs]
        (folder / "labels").mkdir()
        write_label_table(folder / "labels" / f"{file_name(name)}{self.suffix}", labels)
        self.source.write_label_part(folder, file_name(name), dataset, labels)
        return asdict(LabelCounts.sum(run.counts for run in runs))


def _reading(source: DatasetSource) -> str:
    """Options of reading recordings, as a comment; empty where recordings need none."""
    kept = source.kept()
    return f"# recordings read with {json.dumps(kept, sort_keys=True)}\n" if kept else ""


def _counted(runs: Iterable[TrackedScene], counts: dict[str, int]) -> Iterator[TrackedScene]:
    for run in runs:
        counts["frames"] += run.frames
        label_of = {
            id_: c
            for tracks in run.tracks
            for id_, c in zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
        }
        counts["tracks"] += len(label_of)
        for label, number in sorted(Counter(label_of.values()).items()):
            counts[_OF_CLASS + label] = counts.get(_OF_CLASS + label, 0) + number
        counts["boxes"] += sum(len(tracks) for tracks in run.tracks)
        yield run
