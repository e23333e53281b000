"""The record of a run of smoothing, from which its labels can be made again, and these labels.

The configuration of its `RunRecord` is YAML of a `LabelRun`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.given_tracks import TrackedRecordings, read_given_tracks
from data_tools.datasets.results import SceneResult, scene_result
from data_tools.datasets.source import DatasetSource, dataset_names, dataset_source
from pipelines.config import Method
from pipelines.configuration import read_settings, write_settings
from pipelines.report import RunRecord, read_run_record
from pipelines.smoothing import SmoothConfig
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.types import Dataset, Scene


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
        name = kind.name if kind.name in dataset_names() else f"{kind.__module__}:{kind.__qualname__}"
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
