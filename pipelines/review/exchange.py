"""Labels out to a labelling tool, and the edits that were made there back as corrections.

Labels can be made again from the record of their run: the configuration of its `RunRecord` is YAML of a `LabelRun`.
"""

import json
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

import numpy as np

from data_tools.datasets import (
    DatasetSource,
    Edits,
    SceneResult,
    TrackedRecordings,
    correction_lines,
    dataset_names,
    dataset_source,
    exchanged,
    read_from_tool,
    read_given_tracks,
    read_tracks,
    scene_result,
    tool_format,
    tools_of,
    write_correction_lines,
    write_for_tool,
)
from data_tools.files import atomic_directory, parsed_json
from data_tools.lidar import ScanSequence, write_cloud
from pipelines.config import Method
from pipelines.configuration import read_settings, write_settings
from pipelines.report import RunRecord, read_run_record
from pipelines.scale_out import file_name
from pipelines.smoothing import SmoothConfig
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import FloatArray, transform_points
from saga_fg.parts import part_name
from saga_fg.smoothing.corrections import correction_from
from saga_fg.types import Dataset, Scene

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LabelRun:
    """All that labels follow from.

    dataset      name, or MODULE:CLASS; options: its own, as YAML
    tracks       files of other trackers; corrections: a file, "" for none
    directory    where the command ran, for relative paths
    """

    config: SmoothConfig = field(default_factory=SmoothConfig)
    method: Method = "saga"
    dataset: str = ""
    options: str = ""
    tracks: tuple[str, ...] = ()
    corrections: str = ""
    directory: str = ""

    @classmethod
    def of_command(
        cls,
        source: DatasetSource,
        method: Method,
        config: SmoothConfig,
        tracks: Sequence[Path] | None,
        corrections: Path | None,
    ) -> Self:
        """A run of this process; options are left out that YAML can't hold, of a dataset of somebody else."""
        kind, options = type(source), ""
        name = kind.name if kind.name in dataset_names() else part_name(kind)
        with suppress(TypeError):
            options = write_settings(source, comments=False)
        return cls(
            config, method, name, options, tuple(map(str, tracks or ())), str(corrections or ""), str(Path.cwd())
        )

    @property
    def record(self) -> RunRecord:
        """The record, to be written beside the labels."""
        return RunRecord(self.method, write_settings(self, comments=False), {})

    @contextmanager
    def open(self) -> Iterator[tuple[DatasetSource, Dataset]]:
        """The recordings, for the length of a block. Raises `InputError` where they can't be read any more."""
        source = read_settings(dataset_source(self.dataset), self.options, "options")
        with source.open() as dataset:
            given = read_given_tracks(source, [Path(path) for path in self.tracks])
            yield source, TrackedRecordings(dataset, given) if given else dataset


def read_label_run(folder: Path) -> LabelRun:
    """Read the record in a folder of labels. Raises `InputError` where there is none, or it is another's."""
    record = read_run_record(folder) if folder.is_dir() else None
    if record is None:
        raise InputError(f"{folder}: expected a folder that saga-fg smooth wrote, with the record run.json of its run")
    with error_context(f"{folder / 'run.json'}: expected the record of labels"):
        run = read_settings(LabelRun, record.configuration, "configuration")
        if not Path(run.directory).is_dir():
            raise InputError(f"directory: expected the folder where they were made, there is no {run.directory}")
    return run


def labelled_scenes(folder: Path, scenes: Mapping[str, Scene]) -> Iterator[SceneResult]:
    """The labels of the scenes, from the table of the folder or those of its parts, in the order of the recordings.

    Raises `InputError` where there is no table, or it has other scenes.
    """
    tables = [*folder.glob("labels.*"), *sorted((folder / "labels").glob("*.*"))]
    if not tables:
        raise InputError(f"{folder}: expected the table labels.csv, or tables of scenes in labels/, there are none")
    parts = [(table, read_tracks(table, labels=True)) for table in tables]
    for table, rows in parts:
        if others := sorted({*rows.scene.tolist()} - {*scenes}):
            unknown = unknown_name("scene", others[0], tuple(scenes))
            raise InputError(f"{table}: {unknown}; these are another run's labels")
    return (
        scene_result(scene, rows, path) for name, scene in scenes.items() for path, rows in parts if name in rows.scene
    )


SCAN_TIME = 0.06  # s between a moment and its scan
WHEN = ("who", "when")  # of a correction, which do not make it another


def export_labels(folder: Path, run: LabelRun, tool: str, output: Path) -> tuple[int, int, int]:
    """Write the labels of a folder for a tool, a file or folder for each scene; return the numbers of boxes and scans,
    and of boxes that were left out, as their size is unknown.

    output: a new or empty folder, which appears when all is written. Raises `InputError` where the labels or the
    recordings can't be read, and for a folder that is not writable or holds anything: it may be somebody's edits.
    """
    form, boxes, clouds, every = tool_format(tool), 0, 0, 0
    if output.is_dir() and any(output.iterdir()):
        raise InputError(f"{output}: expected a new or an empty folder, it may hold edits")
    with run.open() as (source, dataset), atomic_directory(output) as whole:
        scenes = {name: dataset.scene(name) for name in dataset.scenes}
        scans = source.surroundings(scenes).scans() if form.clouds else {}
        for result in labelled_scenes(folder, scenes):
            name = file_name(result.scene.name)
            boxes += write_for_tool(form.scene_path(whole, name), tool, result)
            every += len(result.found)
            for k, time in enumerate(result.scene.timestamps.tolist()):
                points = ego_points(scans.get(result.scene.name), time)
                if len(points):
                    cloud = whole / name / form.clouds / f"{k:06d}.pcd"
                    cloud.parent.mkdir(exist_ok=True)
                    write_cloud(cloud, points)
                    clouds += 1
    return boxes, clouds, every - boxes


def import_edits(
    folder: Path, run: LabelRun, tool: str, given: Path, file: Path, who: str = ""
) -> tuple[Counter[str], list[str]]:
    """Add what was changed in a tool to a file of corrections; return the numbers of new ones by kind, and what none of
    them can say.

    given: the folder that `export_labels` wrote, edited; scenes that it lacks are as they were. Raises `InputError` for
    what can't be read, and where none of the scenes is there; the file is unchanged then.
    """
    form, found, problems, missing = tool_format(tool), list[dict[str, object]](), list[str](), list[Path]()
    with run.open() as (source, dataset):
        scenes = {name: dataset.scene(name) for name in dataset.scenes}
        results = list(labelled_scenes(folder, scenes))
        labels = {label for each in results for label in each.found.boxes.label.tolist()}
        fixed = source.written.classes
    for result in results:
        path = form.scene_path(given, file_name(result.scene.name))
        if not form.holds(given, file_name(result.scene.name)):
            missing.append(path)
            problems.append(f"{path}: there is no such scene, its labels stay as they are")
            continue
        back = read_from_tool(path, tool, result.scene, fixed or labels, not fixed)
        compared = Edits(exchanged(result), *back)
        checked = [(each, correction_from(each, str(path))) for each in compared.corrections()]
        problems += [f"{one}: {one.too_far}: left out" for _, one in checked if one.too_far]
        found += [record for record, one in checked if not one.too_far]
        for name in sorted({one.label for _, one in checked if one.label and not one.too_far} - labels):
            log.warning("%s: class %s: taken over, no label has had it before", path, name)
        problems += [f"{path}: {line}" for line in compared.problems]
    if len(missing) == len(results):
        other = "".join(f"; this is of {name}" for name in tools_of(given, map(file_name, scenes)))
        raise InputError(f"{given}: expected {missing[0].name}, as written by --export {tool}{other}")
    lines = correction_lines(file)
    there = [_plain(parsed_json(line, str(file))) for line in lines if line.strip()]
    new = [record for record in found if record not in there]
    about = {"who": who, "when": datetime.now(UTC).isoformat(timespec="seconds")}
    if new:
        write_correction_lines(file, [*lines, *(json.dumps({**each, **about}) for each in new)])
    return Counter(str(record["what"]) for record in new), problems


def _plain(record: object) -> object:
    """A correction without its author and time."""
    return {k: v for k, v in record.items() if k not in WHEN} if isinstance(record, dict) else record


def ego_points(scans: ScanSequence | None, time: float) -> FloatArray:
    """Points (N, 3) of the scan of a moment, m, in coordinates of the vehicle; none where there is no scan then."""
    late = np.abs(scans.timestamps - time) if scans is not None else np.empty(0)
    if scans is None or not len(late) or late.min() > SCAN_TIME:
        return np.empty((0, 3))
    return transform_points(scans.ego_T_lidar, scans[int(np.argmin(late))].points)
