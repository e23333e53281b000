"""The nuScenes dataset: official tables and detection results in, `Scene`s out.

World coordinates are the global frame of the recording's map (z up), the vehicle's frame is the tables' ego frame
(origin below the rear axle, x ahead, y left). The frames carry detections in world coordinates, one frame a sample and
sensor, at the sample's time.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from data_tools.datasets.nuscenes.annotations import read_annotations
from data_tools.datasets.nuscenes.result_files import ResultFile, ResultMeta, read_result_file
from data_tools.datasets.nuscenes.scenes import SceneRecord, read_scenes
from data_tools.datasets.nuscenes.splits import split_scenes
from data_tools.datasets.nuscenes.tables import table_folder
from data_tools.files.error_messages import error_context, unknown_name
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Detections, Frame

log = logging.getLogger(__name__)


class NuScenes:
    """Scenes of nuScenes with the detections of one or more result files, one a sensor.

    dataroot, version  the tables are in dataroot/version
    detections         sensor name -> detection-result JSON (official format)
    scenes             names of the scenes to read, None for all
    ground_truth       whether to read the annotations as well
    folder, records    of the tables: where they are, and the chosen scenes by name

    Everything is read and checked at construction; only the chosen scenes are kept. A sample that a detection file does
    not list was not looked at by that sensor and gets no frame (a list without boxes gives an empty frame).
    Raises `InputError` for whatever is missing or broken, and for a sensor that saw no sample of a chosen scene.
    """

    def __init__(
        self,
        dataroot: str | Path,
        version: str,
        detections: Mapping[str, str | Path],
        scenes: Collection[str] | None = None,
        ground_truth: bool = False,
    ) -> None:
        self.dataroot, self.version = dataroot, version
        self.folder = folder = table_folder(dataroot, version)
        tables = read_scenes(folder, scenes)
        self.records: dict[str, SceneRecord] = tables.records
        wanted = {token for record in self.records.values() for token in record.tokens}
        self._paths = {sensor: Path(path) for sensor, path in detections.items()}
        self._results: dict[str, ResultFile] = {}
        for sensor, path in self._paths.items():
            self._results[sensor] = read_result_file(path, "detection", tables.all_samples, wanted)
            missing = len(wanted - self._results[sensor].boxes.rows.keys())
            if missing:
                log.warning(
                    "%s: lists %d of %d samples, the others get no frame", path, len(wanted) - missing, len(wanted)
                )
        if scenes is not None:
            for name in self.records:
                self._check_seen(name)
        self._annotations: dict[str, list[Annotations]] | None = (
            read_annotations(folder, self.records) if ground_truth else None
        )

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the chosen scenes, in the order they were given or, without a choice, of the table."""
        return tuple(self.records)

    @property
    def meta(self) -> ResultMeta:
        """Sensors and data that the detection files use, together."""
        return ResultMeta.union(*(result.meta for result in self._results.values()))

    def split(self, name: str) -> tuple[str, ...]:
        """The scenes of a split that the tables hold (see `split_scenes`)."""
        return split_scenes(self.dataroot, self.version, name)

    def scene(self, name: str) -> Scene:
        """One of the chosen scenes; raises `InputError` for another name."""
        if name not in self.records:
            raise InputError(f"{self.dataroot}: {unknown_name('scene', name, self.scenes)}")
        self._check_seen(name)
        record = self.records[name]
        frames = [
            frame
            for token, time, pose in zip(record.tokens, record.timestamps.tolist(), record.world_T_ego, strict=True)
            for frame in self._frames(token, time, pose)
        ]
        truth: Sequence[Annotations] | None = None if self._annotations is None else self._annotations[name]
        with error_context(str(self.dataroot)):
            return Scene(name, record.timestamps, record.world_T_ego, record.tokens, frames, truth)

    def _frames(self, token: str, time: float, world_T_ego: FloatArray) -> list[Frame]:
        frames = []
        for sensor, result in self._results.items():
            rows = result.boxes.rows.get(token)
            if rows is not None:
                seen = Detections(result.boxes.boxes.select(rows), result.boxes.score[rows])
                frames.append(Frame(time, sensor, seen, world_T_ego, token=token))
        return frames

    def _check_seen(self, name: str) -> None:
        tokens = self.records[name].tokens
        for sensor, result in self._results.items():
            if not any(token in result.boxes.rows for token in tokens):
                raise InputError(
                    f"{self._paths[sensor]}: expected detections of scene {name}, the file lists none of its samples"
                )
