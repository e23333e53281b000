"""Tables of your own: of detections as a dataset of the command, and of tracks and true objects of a program."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from data_tools.datasets.detection_files import TableImport, TrackRows, TruthTable, read_tracks, read_truth, track_rows
from data_tools.datasets.detection_files.dataset import (
    TRUTH_COLUMNS,
    dense_traffic_of,
    read_detections,
    read_scenes_in_parts,
)
from data_tools.datasets.detection_files.tracks import OWN, TRACK_REQUIRED
from data_tools.datasets.results import Results, SceneResult, clear_figures, nearest_rows, table_results
from data_tools.datasets.source import (
    TRACKING,
    ChosenScenes,
    DatasetSource,
    OpenedPart,
    Part,
    Parts,
    Verb,
    file_digest,
    names,
    option,
)
from data_tools.files import expanded, local_copy, name_of
from saga_fg.errors import InputError
from saga_fg.tables import COLUMNS, NAME, SETTLED, TRACK_COLUMNS, DetectionTable, Table, pairs, raw_table, tell
from saga_fg.types import Dataset, Scene, data_frame

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation, Metric
    from saga_fg.numerics import FloatArray

JUDGED: tuple[Verb, ...] = ("evaluate", "evaluate labels", "report", "view")
"""Verbs that compare with true objects."""
COLUMNS_TEXT = (
    "Names of columns in the file, where they are not found: time=ts_ns,x=pos_x,yaw=hdg. `length=` leaves one out."
)
CLASSES_TEXT = "Names of classes: REGULAR_VEHICLE=car,PERSON=pedestrian. `SIGN=` leaves a class out."
UNITS_TEXT = (
    "Units: time=ns (s, ms, us, ns, iso8601, 10Hz), length=ft (m, cm, mm, km, ft), speed=km/h (m/s, km/h, mph, "
    "ft/s), angle=deg (rad, deg; clockwise, clockwise_deg; compass, compass_rad: clockwise from north), score=percent "
    "(share, percent). Of one column: yaw=deg."
)
COORDINATES_TEXT = (
    "Coordinates of rows that say none; all but world need the pose of the vehicle. camera: at its origin, x to the "
    "right, y down, z ahead.  [default: world]"
)
SETTINGS_TEXT = "Settings: dense for road traffic seen by a sensor that stands or hovers, plain for all else"
SORT_TEXT = "Sort the rows by time, in memory."
AS_GIVEN_TEXT = "Read the table as it is said to be, even where its contents contradict it."
IMPORT_TEXT = "YAML file with the same: columns, classes, units, coordinates, sort, as_given."


@dataclass(frozen=True, kw_only=True)
class DetectionFileSource(DatasetSource):
    """Your own detections: a table with a row for each.

    Time, x and y (m) are needed; label, score, sensor, size, heading and more are used where they are there. Columns,
    classes and units may be your own: `saga-fg inspect TABLE` shows how it is understood (see `saga-fg docs formats`).

    \b
    A table in columns, classes and units of its own:
      saga-fg inspect found.parquet
      saga-fg track file found.parquet --columns time=stamp,x=east,y=north \\
          --classes REGULAR_VEHICLE=car,PERSON=pedestrian --units angle=deg --sort --output tracks.csv
    """

    name = "file"
    has_truth = False
    truth_option = "--truth"
    summarised = True
    example = "detections.csv"
    detections: list[str] | None = option(
        "Table of detections: .csv, .ndjson, .jsonl, .npz, .parquet or .feather (extra [parquet]). In parallel: "
        "several of them, patterns, or URLs.",
        None,
        metavar="TABLE",
        required=(*TRACKING, "learn interactions"),
        argument=True,
    )
    truth: str | None = option(
        "Table of true objects, a row for each and moment: time, id, x, y, and what else is known.",
        None,
        metavar="TABLE",
        verbs=JUDGED,
    )
    columns: str | None = option(
        COLUMNS_TEXT,
        None,
        metavar="OURS=THEIRS,...",
    )
    classes: str | None = option(
        CLASSES_TEXT,
        None,
        metavar="THEIRS=OURS,...",
    )
    units: str | None = option(
        UNITS_TEXT,
        None,
        metavar="KIND=UNIT,...",
    )
    coordinates: Literal["world", "ego", "sensor", "camera"] | None = option(COORDINATES_TEXT, None)
    sort: bool = option(SORT_TEXT, False)
    as_given: bool = option(AS_GIVEN_TEXT, False)
    settings: Literal["plain", "dense"] | None = option(
        f"{SETTINGS_TEXT}.  [default: what the first rows look like]",
        None,
        verbs=("track", "smooth", "evaluate", "evaluate labels"),
    )
    table_import: TableImport | None = option(IMPORT_TEXT, None, flag="--import", metavar="FILE")
    truth_import: TableImport | None = option(
        "YAML file with the same, for --truth alone.", None, flag="--truth-import", metavar="FILE", verbs=JUDGED
    )
    scenes: str | None = option("Scene names with commas between them; all if left out.", None)

    def __post_init__(self) -> None:
        vars(self)["has_truth"] = self.truth is not None
        _ = self.how  # what is wrong in it is said before anything is read

    @property
    def how(self) -> TableImport:
        """Options for reading tables."""
        return self._over(self.table_import)

    @property
    def how_detections(self) -> TableImport:
        """Options for reading detections: without what a file for --import says of columns of tracks alone."""
        return self._over((self.table_import or TableImport()).naming(COLUMNS))

    def _over(self, base: TableImport | None) -> TableImport:
        own = TableImport(
            pairs("--columns", self.columns),
            pairs("--classes", self.classes),
            pairs("--units", self.units),
            self.coordinates or "",
            self.sort,
            self.as_given,
        )
        return own.over(base or TableImport())

    def dense_traffic(self) -> str:
        """Why the first rows look like dense road traffic, "" if they do not, or are not those of one file here."""
        if len(self.detections or ()) != 1 or not Path(self._table()).is_file():
            return ""
        with local_copy(self._table()) as path:
            return dense_traffic_of(path, self.how_detections)

    def __str__(self) -> str:
        return ", ".join(name_of(place) for place in self.detections or ()) or "a table of tracks"

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        if truth and self.truth is not None:
            with self._true_scenes() as dataset:
                yield dataset
            return
        if not self.detections:
            yield NoScenes()
            return
        with local_copy(self._table()) as path:
            dataset = read_detections(path, self.how_detections)
        yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes, f"{path}: --scenes")

    def restricted(self, scenes: Collection[str]) -> Self:
        return replace(self, scenes=None)

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        if self.scenes is not None:
            raise InputError("--scenes: all scenes of a file are done with --workers or --ray")
        if not self.detections:
            yield Parts((), (), NoScenes())
            return
        parts = [table_part(url, self.how_detections) for url in expanded(self.detections or ())]
        yield Parts([part.name for part in parts], parts)

    @contextmanager
    def stream(self) -> Iterator[Iterator[Scene]]:
        chosen = None if self.scenes is None else names("--scenes", self.scenes)
        with local_copy(self._table()) as path:
            yield read_scenes_in_parts(path, scenes=chosen, how=self.how_detections)

    def read_results(self, result: Path, truth: bool = True) -> Results:
        return Results(self._results(result, truth), score_tables)

    def _results(self, result: Path, truth: bool) -> Mapping[str, SceneResult]:
        rows = read_tracks(result, self.how, lenient=True)
        if truth and self.truth is not None:
            with self._true_scenes() as true_scenes:
                return table_results(rows, result, true_scenes, self.scenes is not None, self.how, judged=True)
        if self.detections is None:
            return table_results(rows, result, None, how=self.how)
        with replace(self, columns=None, table_import=self.how.naming(COLUMNS)).open() as dataset:
            return table_results(rows, result, dataset, every_scene=truth, how=self.how, own_times=not truth)

    def kept(self) -> Mapping[str, Any]:
        return self.how.values()

    def with_kept(self, kept: Mapping[str, Any]) -> Self:
        if self.table_import is not None or not kept:
            return self
        known = {field.name for field in fields(TableImport)}
        try:
            how = TableImport(**{name: kept[name] for name in kept if name in known})
        except (AttributeError, TypeError) as error:
            raise InputError(f"the record of the run: recordings: expected how they were read: {error}") from error
        return replace(self, table_import=how)

    @contextmanager
    def _true_scenes(self) -> Iterator[Dataset]:
        """The scenes of --truth, with the frames of the detections where these are there."""
        assert self.truth is not None
        own = self.truth_import
        with local_copy(self.truth) as path:
            truth = read_truth(path, self.how) if own is None else read_truth(path, own, "--truth-import")
        dataset: Dataset = truth
        if self.detections is not None:
            with local_copy(self._table()) as path:
                dataset = DetectedTruth(truth, read_detections(path, self.how.naming(COLUMNS)))
        yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes, f"{self.truth}: --scenes")

    def _table(self) -> str:
        if len(self.detections or ()) != 1:
            raise InputError(
                "expected one table of detections, or tracks to smooth; several tables need --workers N or --ray, "
                "and a folder as --output"
            )
        return (self.detections or [""])[0]


def score_tables(
    scenes: Mapping[str, SceneResult], hota: bool = False, innovations: Mapping[str, FloatArray] | None = None
) -> Evaluation:
    """All figures that can be computed here."""
    return clear_figures(scenes, hota or find_spec("trackeval") is not None, innovations, sweep=True)


class NoScenes:
    """A dataset without recordings: tables of tracks bring their own."""

    scenes: tuple[str, ...] = ()

    def scene(self, name: str) -> Scene:
        """Raises `InputError`: there is none."""
        raise InputError(f"scene {name}: expected a table of detections, there is none")


class DetectedTruth:
    """The scenes of a table of true objects, with the frames of a table of detections.

    Where one of them does not name its only scene, it is that of the other. Where the truth has no poses of the
    vehicle, they are those of the nearest moment of the detections.
    """

    def __init__(self, truth: TruthTable, detections: Dataset) -> None:
        self._truth, self._detections = truth, detections
        same = len(truth.scenes) == 1 and len(detections.scenes) == 1
        self._true_name = {detections.scenes[0]: truth.scenes[0]} if same else {}
        self.scenes: tuple[str, ...] = detections.scenes if same else truth.scenes

    def scene(self, name: str) -> Scene:
        """Read one of the scenes; raises `InputError` where a table does not have it."""
        true, detected = self._truth.scene(self._true_name.get(name, name)), self._detections.scene(name)
        poses = true.world_T_ego
        if not self._truth.posed and len(detected):
            poses = detected.world_T_ego[nearest_rows(detected.timestamps, true.timestamps)]
        return replace(
            detected,
            timestamps=true.timestamps,
            world_T_ego=poses,
            tokens=true.tokens,
            ground_truth=true.ground_truth,
        )


def table_part(url: str, how: TableImport) -> Part:
    """A table of detections, a local file or one that fsspec can open by its URL, named without its suffix."""
    return Part(Path(name_of(url)).stem, partial(_opened_table, url, how))


@contextmanager
def _opened_table(url: str, how: TableImport) -> Iterator[OpenedPart]:
    """Open a table with the digest of the file."""
    with local_copy(url) as path:
        yield OpenedPart({name_of(url): file_digest(path)}, lambda: read_detections(path, how))


_DEPTH = 6  # callers between a warning and the program


def evaluate(
    tracks: Table,
    truth: Table,
    how: TableImport | None = None,
    truth_how: TableImport | None = None,
    metrics: Sequence[str | Metric] = (),
    hota: bool | None = None,
) -> Evaluation:
    """Judge a table of tracks by one of true objects, as `saga-fg evaluate file TRACKS --truth TRUTH` does.

    tracks     a row for each and moment: timestamp, id, x, y, and where known label, score, sizes, covariances, scene,
               of `saga_fg.track` or of any tracker; pandas, Polars or Arrow; what `saga_fg.smooth` returns; `Tracks`
               or `Labels`, or a list of them
    truth      the same of true objects; `visible` 0 where hidden
    how        what it takes to understand the tables, without effect on tracks of saga-fg; truth_how: that of the truth
    metrics    of your own, as objects or names
    hota       whether HOTA is computed, which needs the extra [eval]; None: where that is installed

    Warns (`UserWarning`) of what is doubtful. Raises `InputError` for tables that cannot be used or do not fit.
    """
    results = found_results(tracks, truth=truth, how=how, truth_how=truth_how)
    score = partial(clear_figures, sweep=True)
    return Results(results, score).evaluate(find_spec("trackeval") is not None if hota is None else hota, None, metrics)


def _as_table(tracks: Any) -> Table:
    """A table of labels, `Tracks`, `Labels` or a list of these; a table stays as it is."""
    if callable(getattr(tracks, "boxes", None)):
        return tracks.boxes()  # of `saga_fg.smooth`
    moments = tracks if isinstance(tracks, list | tuple) else [tracks]
    if not moments or not all(hasattr(moment, "table_columns") for moment in moments):
        return tracks
    parts = [moment.table_columns() for moment in moments]
    return data_frame({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def found_results(
    tracks: Table,
    detections: Table | None = None,
    truth: Table | None = None,
    how: TableImport | None = None,
    truth_how: TableImport | None = None,
) -> dict[str, SceneResult]:
    """The tracks of a table by scene, beside detections and true objects where these are given; else as `evaluate`."""
    tracks = _as_table(tracks)
    names = set(getattr(tracks, "column_names", getattr(tracks, "columns", ())))  # of Arrow, or of the others
    rows = _rows(tracks, TableImport(as_given=True) if names >= OWN else how)
    dataset: Dataset | None = None
    if detections is not None:
        dataset = DetectionTable(raw_table(detections, how))
    if truth is not None:
        within = "how" if truth_how is None else "truth_how"
        raw = raw_table(truth, truth_how or how, TRUTH_COLUMNS, TRACK_REQUIRED, within, lenient=True)
        true = TruthTable.from_table(raw, partial(tell, depth=_DEPTH))
        dataset = true if dataset is None else DetectedTruth(true, dataset)
    return table_results(
        rows, Path(NAME), dataset, how=how, judged=truth is not None, own_times=truth is None and dataset is not None
    )


def _rows(tracks: Table, how: TableImport | None) -> TrackRows:
    raw = raw_table(tracks, how, (*TRACK_COLUMNS, SETTLED), TRACK_REQUIRED, lenient=True)
    return track_rows(raw, partial(tell, depth=_DEPTH))
