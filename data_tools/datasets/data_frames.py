"""Tables of tracks and true objects of programs, of pandas, Polars or Arrow: judged beside each other."""

from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from data_tools.datasets.detection_file_source import DetectedTruth
from data_tools.datasets.detection_files import TrackRows, TruthTable, track_rows
from data_tools.datasets.detection_files.dataset import TRUTH_COLUMNS
from data_tools.datasets.detection_files.tracks import OWN, TRACK_REQUIRED
from data_tools.datasets.results import Results, SceneResult, clear_figures, table_results
from data_tools.evaluation import Evaluation, Metric
from saga_fg.tables import NAME, SETTLED, TRACK_COLUMNS, DetectionTable, Table, TableImport, raw_table, tell
from saga_fg.types import Dataset

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
               of `saga_fg.track` or of any tracker; pandas, Polars or Arrow
    truth      the same of true objects; `visible` 0 where hidden
    how        what it takes to understand the tables, without effect on tracks of saga-fg; truth_how: that of the truth
    metrics    of your own, as objects or names
    hota       whether HOTA is computed, which needs the extra [eval]; None: where that is installed

    Warns (`UserWarning`) of what is doubtful. Raises `InputError` for tables that cannot be used or do not fit.
    """
    results = found_results(tracks, truth=truth, how=how, truth_how=truth_how)
    score = partial(clear_figures, sweep=True)
    return Results(results, score).evaluate(find_spec("trackeval") is not None if hota is None else hota, None, metrics)


def found_results(
    tracks: Table,
    detections: Table | None = None,
    truth: Table | None = None,
    how: TableImport | None = None,
    truth_how: TableImport | None = None,
) -> dict[str, SceneResult]:
    """The tracks of a table by scene, beside detections and true objects where these are given; else as `evaluate`."""
    names = set(getattr(tracks, "column_names", getattr(tracks, "columns", ())))  # of Arrow, or of the others
    rows = _rows(tracks, TableImport(as_given=True) if names >= OWN else how)
    dataset: Dataset | None = None
    if detections is not None:
        dataset = DetectionTable(raw_table(detections, how))
    if truth is not None:
        within = "how" if truth_how is None else "truth_how"
        raw = raw_table(truth, truth_how or how, TRUTH_COLUMNS, TRACK_REQUIRED, within)
        true = TruthTable.from_table(raw, partial(tell, depth=_DEPTH))
        dataset = true if dataset is None else DetectedTruth(true, dataset)
    return table_results(
        rows, Path(NAME), dataset, how=how, judged=truth is not None, own_times=truth is None and dataset is not None
    )


def _rows(tracks: Table, how: TableImport | None) -> TrackRows:
    return track_rows(raw_table(tracks, how, (*TRACK_COLUMNS, SETTLED), TRACK_REQUIRED), partial(tell, depth=_DEPTH))
