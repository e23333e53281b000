"""Labels of a whole table of detections in one call, beside `saga_fg.track`."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from saga_fg.model import Sensor
from saga_fg.smoothing.corrections import Correction, checked_corrections, corrections_in, unfit
from saga_fg.smoothing.labelling import RecordingLabels
from saga_fg.smoothing.recording import LabelBuilder, LabelModel
from saga_fg.smoothing.settings import SmoothingSettings
from saga_fg.smoothing.states import Labels
from saga_fg.tables import Table, TableImport, raw_table, scenes_of, table_like
from saga_fg.tracking import UNKNOWN_SENSORS, Tracker, TrackerSettings, check_scenes


@dataclass(frozen=True, eq=False)
class TableLabels:
    """The labels of the scenes of a table of detections, by name.

    detections: whose kind of table `boxes` and `review` give; named: they have a column `scene`
    """

    scenes: Mapping[str, RecordingLabels]
    detections: Table
    named: bool

    def __repr__(self) -> str:
        """The numbers of scenes and boxes, and the objects most worth a look."""
        boxes = sum(len(moment.tracks) for one in self.scenes.values() for part in one for moment in part)
        title = f"labels of {len(self.scenes)} scenes, {boxes} boxes (.boxes()); objects most worth a look (.review()):"
        return f"{title}\n{self.review()}"

    def boxes(self) -> Table:
        """A row for each box, with the columns of `labels.csv`."""
        found = [(name, moment) for name, one in self.scenes.items() for part in one for moment in part]
        return self._table([(name, moment.table_columns()) for name, moment in found], Labels.empty().table_columns())

    def review(self) -> Table:
        """A row for each object worth a look, with the columns of `review.csv`: in each scene those first that are most
        worth it."""
        found = [(name, one.review().table_columns()) for name, one in self.scenes.items()]
        return self._table(found, RecordingLabels([]).review().table_columns())

    def _table(self, parts: Sequence[tuple[str, Mapping[str, Any]]], none: Mapping[str, Any]) -> Table:
        found = []
        for name, columns in parts or [("", none)]:
            scene = {"scene": np.full(len(columns["id"]), name)} if self.named else {}
            found.append({**scene, **columns})
        return table_like(self.detections, found)


def smooth(
    detections: Table,
    settings: TrackerSettings | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    smoothing: SmoothingSettings | None = None,
    corrections: Iterable[Correction | Mapping[str, Any]] = (),
    how: TableImport | None = None,
) -> TableLabels:
    """Label a table of detections, of pandas, Polars or Arrow, with past and future of every object.

    detections, settings, sensors  as `saga_fg.track` takes them
    smoothing    settings of the passes over the whole table
    corrections  by a person, as `Correction` or as a mapping like a line of a file of corrections
    how          what it takes to understand the table: columns, classes, units, coordinates

    Warns (`UserWarning`) as `saga_fg.track` does, and of each correction that does not hold. Raises `InputError` for a
    table or a correction that can't be used.
    """
    how = how or TableImport()
    settings = TrackerSettings(min_hits=2) if settings is None else settings
    given, sensors = checked_corrections(corrections), UNKNOWN_SENSORS if sensors is None else sensors
    raw = raw_table(detections, how)
    scenes = scenes_of(raw)
    check_scenes(raw, scenes, settings, sensors)
    labels, outcomes = {}, []
    for scene in scenes:
        mine = corrections_in(scene.name, given)
        model = LabelModel(settings, sensors, smoothing or SmoothingSettings(), (), mine)
        builder = LabelBuilder(Tracker(settings, sensors), model)
        builder.add(scene.frames, scene.timestamps)
        labels[scene.name], _ = builder.finish()
        outcomes += [(one.origin, why) for one, why in builder.outcomes]
    for problem in unfit(given, outcomes):
        warnings.warn(problem, stacklevel=2)
    return TableLabels(labels, detections, "scene" in raw.columns)
