"""Tracking as a task for many scenes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from data_tools.datasets.nuscenes import ResultMeta
from pipelines.config import Method, TrackConfig
from pipelines.configuration import write_settings
from pipelines.scale_out.manifest import file_name
from pipelines.tracking import TrackedScene, track_dataset
from saga_fg.types.dataset import Dataset

ResultFormat = Literal["nuscenes", "kitti", ".csv", ".ndjson", ".jsonl"]


@dataclass(frozen=True)
class TrackTask:
    """Track every scene of an input; results in `tracks/`, in the official format or as a table of that suffix.

    meta: what the detections rest on, for nuScenes.
    """

    settings: TrackConfig
    method: Method
    form: ResultFormat
    meta: ResultMeta = field(default_factory=ResultMeta)

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        head = [f"track, method {self.method}, results as {self.form}", *([str(self.meta)] * (self.form == "nuscenes"))]
        return "".join(f"# {line}\n" for line in head) + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the tracks; counts scenes, frames, tracks and boxes."""
        from data_tools.datasets.detection_files import write_tracks
        from data_tools.datasets.kitti import KittiTracking, write_kitti_results
        from data_tools.datasets.nuscenes import write_tracking_results

        counts = dict.fromkeys(("frames", "tracks", "boxes"), 0)
        runs = _counted(track_dataset(dataset, lambda: self.settings.new_tracker(self.method)), counts)
        scenes = ((run.scene, run.tracks) for run in runs)
        tracks = folder / "tracks"
        tracks.mkdir()
        if self.form == "nuscenes":
            write_tracking_results(folder / self.result(name), scenes, self.meta)
        elif self.form == "kitti":
            assert isinstance(dataset, KittiTracking)
            write_kitti_results(tracks, dataset, scenes)
        else:
            write_tracks(folder / self.result(name), scenes)
        return counts

    def result(self, name: str) -> str:
        """The path of the result of input `name`, relative to the output."""
        suffix = {"nuscenes": ".json", "kitti": ".txt"}.get(self.form, self.form)
        return f"tracks/{file_name(name)}{suffix}"


def _counted(runs: Iterable[TrackedScene], counts: dict[str, int]) -> Iterator[TrackedScene]:
    for run in runs:
        counts["frames"] += run.frames
        counts["tracks"] += len({id_ for tracks in run.tracks for id_ in tracks.id.tolist()})
        counts["boxes"] += sum(len(tracks) for tracks in run.tracks)
        yield run
