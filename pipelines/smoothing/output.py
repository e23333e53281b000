"""A folder of labels, the output of a run of smoothing.

labels.csv       a row per box (or .ndjson, .parquet)
review.csv       a row per object worth a look, those first that are most worth it
corrections.csv  what became of corrections, where there are some
run.json         record of the run, for reviews
summary.json     how many boxes of each scene were observed, filled, extended and dropped
tracking.json    nuScenes: the official tracking result
VERSION/         nuScenes: tables whose annotations are the labels
label_02/        KITTI: text as of ground truth
results/         KITTI: the same with scores, as evaluators take it
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from data_tools.datasets.corrections import write_outcomes
from data_tools.datasets.detection_files import write_label_table, write_review
from data_tools.figures import write_figures
from data_tools.files import atomic_directory
from pipelines.report.page import RunRecord, write_run_record
from pipelines.smoothing.streaming import SmoothedScene
from saga_fg.smoothing import LabelCounts, Labels
from saga_fg.types import Scene

_TABLES = ("labels.csv", "labels.ndjson", "labels.parquet", "review.csv", "corrections.csv", "summary.json", "run.json")


def write_labels(
    directory: str | Path,
    smooth: Callable[[Path], Iterable[SmoothedScene]],
    suffix: str = ".csv",
    write_others: Callable[[Path, Sequence[tuple[Scene, Sequence[Labels]]]], None] | None = None,
    record: RunRecord | None = None,
) -> tuple[SmoothedScene, ...]:
    """Write the table of boxes and the summary; the folder is checked before the first recording is smoothed.

    smooth        makes the labels; it is called with a folder where they may wait (`smooth_stream`)
    write_others  adds the labels of all scenes in another format to the folder
    record        of the run
    """
    with atomic_directory(directory, known=_TABLES) as folder, TemporaryDirectory(dir=folder) as spools:
        done = tuple(smooth(Path(spools)))
        write_label_table(folder / f"labels{suffix}", chain.from_iterable(run.parts for run in done))
        if record is not None:
            write_run_record(folder, record)
        write_review(folder / "review.csv", {run.name: run.review for run in done})
        if outcomes := [outcome for run in done for outcome in run.outcomes]:
            write_outcomes(folder / "corrections.csv", outcomes)
        total = LabelCounts.sum(run.counts for run in done)
        scenes = {run.name: {**asdict(run.counts), "seconds": round(run.seconds, 3)} for run in done}
        write_figures(folder / "summary.json", {"total": asdict(total), "scenes": scenes})
        if write_others is not None:
            write_others(folder, [part for run in done for part in run.parts])
    return done
