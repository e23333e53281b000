"""The methods, and the graph-aware tracker with each component off, on the same recordings.

Every variant tracks every scene, in turn; times are CPU times of the tracker alone. Changes from `kf` come with
intervals over scenes: errors at labels from their sums, figures averaged over recall by scoring each drawn set of
scenes anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.recording_sets import RecordingOptions, RecordingSet, Score, chosen_sets
from benchmarks.runner import Data, Interval, Row, Rows, clocked, each, paired_bootstrap, resampled, square_sums
from benchmarks.variants import COMPONENTS, SHIPPED, contenders
from data_tools.metrics import LabelErrors, calibration, error_summary, errors_by_class
from pipelines.cli.options import Config
from pipelines.config import load_config
from pipelines.learning.interactions import Contender
from pipelines.tracking import TrackedScene, track_scene
from saga_fg.kernels.compilation import load_kernels

KF, BASELINE = "kf", "centerpoint"
ERRORS = ("position", "velocity", "heading")


def tracking(
    *,
    data: Data = None,
    recorded: RecordingOptions,
    compared: Annotated[
        str | None,
        typer.Option("--contenders", help="Methods and components, by name, with commas.  [default: all]"),
    ] = None,
    components: Annotated[bool, typer.Option(help="Switch the components off one by one as well.")] = True,
    draws: Annotated[int, typer.Option("--draws", min=0, help="Drawn sets of scenes for intervals; 0: none.")] = 200,
    config: Config = None,
) -> Rows:
    """Track the same recordings by every method, and with every component off; compare accuracy and time.

    The file of --config changes the shipped settings of every kind of data.

    \b
    Examples:
      python -m benchmarks tracking --sets simulated --scenes 4 --draws 0
      python -m benchmarks tracking --data data --json figures.json --markdown tables.md
      python -m benchmarks tracking --data data --sets kitti --no-components
      python -m benchmarks tracking --data data --sets megvii --contenders 'saga,kf,graph matching'
    """
    load_kernels()
    wanted = compared or ",".join(variant.name for variant in (*SHIPPED, *(COMPONENTS if components else ())))
    for recordings in chosen_sets(recorded.sets, data, recorded.scenes, recorded.test, recorded.viewpoint):
        base = load_config(recordings.family, config)
        yield from set_rows(recordings, contenders(recordings.family, base, wanted, ()), draws)


def set_rows(recordings: RecordingSet, compared: Sequence[Contender], draws: int) -> Iterator[Row]:
    """Accuracy and time of all, changes from kf, and how many errors are within the ellipses."""
    scenes, names_of = recordings.dataset.scenes, [one.name for one in compared]
    runs: dict[str, dict[str, TrackedScene]] = {name: {} for name in names_of}
    seconds = dict.fromkeys(names_of, 0.0)
    for name in each(scenes, recordings.name):
        scene = recordings.scene(name)
        for one in compared:
            runs[one.name][name], ms = clocked(track_scene, scene, one.config.new_tracker(one.method))
            seconds[one.name] += ms / 1e3
    frames = sum(run.frames for run in next(iter(runs.values())).values())
    scores = {name: recordings.score(found) for name, found in runs.items()}
    for name, score in scores.items():
        errors = error_summary(LabelErrors.pool(score.errors))
        about = {"variant": name, **score.figures_of(range(len(scenes)))}
        rmse = {"position": errors.position, "velocity": errors.velocity, "velocity moving": errors.velocity_moving}
        ms = 1e3 * seconds[name] / frames
        ratio = seconds[name] / seconds[BASELINE] if BASELINE in seconds else None
        title = f"{recordings.name}: {len(scenes)} scenes; RMSE of position in m, of velocity in m/s"
        yield title, {**about, **rmse, "ms / frame": ms, "/ centerpoint": ratio}
    for name in names_of if KF in scores and draws else ():
        if name not in (KF, BASELINE) and (found := changes(scores[name], scores[KF], recordings.units, draws)):
            title = f"{recordings.name}: changes from kf (RMSE: relative), 95 % intervals over scenes"
            yield title, {"variant": name, **found}
    for row in scores[names_of[0]].class_rows():
        yield f"{recordings.name}: classes by {names_of[0]}", row
    for label, errors_of in errors_by_class(LabelErrors.pool(scores[names_of[0]].errors)).items():
        c = calibration(errors_of)
        if c.enough_data:
            shares = {f"in {100 * p:g} %": share for p, share in c.coverage.items()}
            about = {"class": label, "objects": c.objects, "boxes": c.boxes, "ANEES / 2": c.anees}
            yield f"{recordings.name}: errors within the ellipses of {names_of[0]}", {**about, **shares}


def changes(score: Score, base: Score, units: Sequence[Sequence[int]], draws: int) -> dict[str, Any]:
    """Figures as differences, RMSEs as relative changes; none of less than two scenes that don't overlap."""
    if len(units) < 2:
        return {}

    def figures(rows: Sequence[int]) -> dict[str, float]:
        theirs = base.figures_of(rows)
        found = {name: value - theirs[name] for name, value in score.figures_of(rows).items() if name in theirs}
        return {**found, **({"IDS, relative": found["IDS"] / (theirs["IDS"] or np.nan)} if "IDS" in found else {})}

    result: dict[str, Interval] = resampled(figures, units, draws)
    for name in ERRORS:
        a, b = (
            [np.sum([square_sums(one.errors[row].sample(name)) for row in unit], axis=0) for unit in units]
            for one in (score, base)
        )
        result[f"{name} RMSE"] = paired_bootstrap(a, b)
    return result
