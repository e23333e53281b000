"""Smoothing as a task for many scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from data_tools.datasets.nuscenes import ResultMeta
from pipelines.config import Method
from pipelines.configuration import write_settings
from pipelines.scale_out.manifest import file_name
from pipelines.smoothing import SmoothConfig, smooth_dataset
from saga_fg.smoothing import LabelCounts
from saga_fg.types.dataset import Dataset

LabelForm = Literal["nuscenes", "kitti", "table"]


@dataclass(frozen=True)
class SmoothTask:
    """Label every scene of an input.

    form    "table": labels/NAME.csv alone; "nuscenes": tracking/NAME.json and objects/NAME.ndjson too, which
            `merge_tracking_results` and `merge_label_parts` make one; "kitti": label_02/ and results/ too
    suffix  of the table: .csv, .ndjson or .parquet
    meta    what the detections rest on, for nuScenes
    """

    settings: SmoothConfig
    method: Method
    form: LabelForm
    suffix: str = ".csv"
    meta: ResultMeta = field(default_factory=ResultMeta)

    @property
    def configuration(self) -> str:
        """The method, the form of the results, and the settings."""
        head = [f"smooth, method {self.method}, results as {self.form}, {self.suffix}"]
        head += [str(self.meta)] * (self.form == "nuscenes")
        return "".join(f"# {line}\n" for line in head) + write_settings(self.settings, comments=False)

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        """Write the labels; counts objects, and boxes by where they come from."""
        from data_tools.datasets.kitti import KittiTracking, write_kitti_results
        from data_tools.datasets.nuscenes import write_tracking_results
        from data_tools.export.labels import write_kitti_labels, write_label_part, write_label_table

        runs = tuple(smooth_dataset(dataset, self.settings, self.method))
        labels = [(run.scene, run.labels) for run in runs]
        tracks = [(run.scene, run.tracks) for run in runs]
        for kind in {"nuscenes": ("labels", "tracking", "objects")}.get(self.form, ("labels",)):
            (folder / kind).mkdir()
        write_label_table(folder / "labels" / f"{file_name(name)}{self.suffix}", labels)
        if self.form == "nuscenes":
            write_tracking_results(folder / self.tracking(name), tracks, self.meta)
            write_label_part(folder / self.objects(name), labels)
        elif self.form == "kitti":
            assert isinstance(dataset, KittiTracking)
            write_kitti_labels(folder / "label_02", dataset, labels)
            write_kitti_results(folder / "results", dataset, tracks)
        return asdict(LabelCounts.sum(run.counts for run in runs))

    def tracking(self, name: str) -> str:
        """nuScenes: the path of an input's tracking result, relative to the output."""
        return f"tracking/{file_name(name)}.json"

    def objects(self, name: str) -> str:
        """nuScenes: the path of an input's annotations, relative to the output."""
        return f"objects/{file_name(name)}.ndjson"
