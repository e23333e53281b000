"""Tables of detections as a dataset of the command."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

from data_tools.datasets.detection_files.dataset import read_detections, read_scenes_in_parts
from data_tools.datasets.parts import OpenedPart, Parts, file_digest
from data_tools.datasets.results import SceneResult, read_table_results
from data_tools.datasets.source import TRACKING, ChosenScenes, DatasetSource, names, option
from data_tools.files.remote_files import expanded, is_url, local_copy, name_of
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene


@dataclass(frozen=True, kw_only=True)
class DetectionFileSource(DatasetSource):
    """Your own detections: a table with a row for each.

    The columns timestamp (s), x and y (m) are needed; label, score, sensor, size, heading and more are used where they
    are there (see `saga-fg docs formats`).
    """

    name = "file"
    has_truth = False
    example = "detections.csv"
    detections: list[str] | None = option(
        "Table of detections: .csv, .ndjson, .jsonl or .npz. In parallel: several of them, patterns, URLs, or lists of "
        "such in a .txt file.",
        None,
        metavar="TABLE",
        required=(*TRACKING, "learn interactions"),
        argument=True,
    )
    scenes: str | None = option("Scene names with commas between them; all if left out.", None)
    table: Literal["csv", "ndjson"] = option("Format of the tables, in parallel.", "csv", verbs=("track",))

    @property
    def title(self) -> str:
        return ", ".join(name_of(place) for place in self.detections or ()) or "a table of tracks"

    @property
    def tracks_suffix(self) -> str:
        return f".{self.table}"

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        with local_copy(self._table()) as path:
            dataset = read_detections(path)
        yield dataset if self.scenes is None else ChosenScenes(dataset, self.scenes, f"{path}: --scenes")

    def restricted(self, scenes: Collection[str]) -> Self:
        return replace(self, scenes=None)

    def input_files(self) -> tuple[Path, ...]:
        return tuple(Path(place) for place in self.detections or () if not is_url(place))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        if self.scenes is not None:
            raise InputError("--scenes: all scenes of a file are done with --workers or --ray")
        parts = [DetectionFilePart(url) for url in expanded(self.detections or ())]
        yield Parts([part.name for part in parts], parts)

    def stream(self) -> AbstractContextManager[Iterator[Scene]]:
        return self._stream()

    @contextmanager
    def _stream(self) -> Iterator[Iterator[Scene]]:
        chosen = None if self.scenes is None else names("--scenes", self.scenes)
        with local_copy(self._table()) as path:
            yield read_scenes_in_parts(path, scenes=chosen)

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        if self.detections is None:
            return read_table_results(result, None)
        with self.open() as dataset:
            return read_table_results(result, dataset, every_scene=True)

    def _table(self) -> str:
        if len(self.detections or ()) != 1:
            raise InputError(
                "expected one table of detections; several need --workers N or --ray, and a folder as --output"
            )
        return (self.detections or [""])[0]


@dataclass(frozen=True)
class DetectionFilePart:
    """A table of detections, a local file or one that fsspec can open by its URL, read at the worker."""

    url: str

    @property
    def name(self) -> str:
        """The name of the file without its suffix."""
        return Path(name_of(self.url)).stem

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digest of the file."""
        with local_copy(self.url) as path:
            yield OpenedPart({name_of(self.url): file_digest(path)}, lambda: read_detections(path))
