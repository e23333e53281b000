"""A dataset for all verbs of the command: its options, how it opens, how its results are written, read and scored.

A new dataset is a dataclass derived from `DatasetSource`, whose fields are its options:

    @dataclass(frozen=True, kw_only=True)
    class Mine(DatasetSource):
        "My recordings, a folder each."

        name = "mine"
        folder: str = option("Folder of the recordings, or its URL.")

        @contextmanager
        def open(self, truth: bool = False) -> Iterator[Dataset]:
            yield MyRecordings(self.folder, truth)

Everything else has a default: tables of tracks and labels as results, scored by CLEAR figures and RMSE.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from data_tools.files.error_messages import unknown_name
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from data_tools.datasets.area_map import AreaMap
    from data_tools.datasets.parts import Parts
    from data_tools.datasets.results import SceneResult
    from data_tools.evaluation import Evaluation
    from data_tools.lidar.scan import ScanSequence
    from data_tools.plausibility import Mend
    from saga_fg.numerics.arrays import FloatArray
    from saga_fg.smoothing import Labels
    from saga_fg.types.dataset import Dataset, Scene
    from saga_fg.types.track import Tracks

Verb = Literal[
    "track", "smooth", "evaluate", "evaluate labels", "benchmark", "report", "view", "learn noise", "learn interactions"
]

TRACKING: tuple[Verb, ...] = ("track", "smooth", "evaluate labels", "benchmark", "learn noise")
"""Verbs that need detections."""

TrackedScenes = Iterable[tuple["Scene", Sequence["Tracks"]]]
"""Scenes with one `Tracks` for each of their timestamps."""

Images = Mapping[str, Sequence[Path | None]]
"""Image files by camera, for each moment of a scene."""

Innovations = Mapping[str, "FloatArray"]
"""Squared distances of tracks and the detections they took, in sigmas, by class."""

LabelledScenes = Iterable[tuple["Scene", Sequence["Labels"]]]
"""Scenes with one `Labels` for each of their timestamps."""


def option(
    text: str,
    default: Any = MISSING,
    *,
    flag: str = "",
    metavar: str | None = None,
    least: float | None = None,
    verbs: tuple[Verb, ...] = (),
    required: tuple[Verb, ...] = (),
    argument: bool = False,
) -> Any:
    """A field that is an option of the command; without a default it is required.

    text      help; flag: `--name` of the field with dashes if left out; metavar: name of its value in the help
    least     least number that is allowed
    verbs     that have the option; all if left out
    required  verbs that require it although it has a default
    argument  whether it is an argument, not an option, of verbs that read no result

    A field of a dataclass of settings is read from a YAML file.
    """
    metadata = {
        "text": text,
        "flag": flag,
        "metavar": metavar,
        "least": least,
        "verbs": verbs,
        "required": required,
        "argument": argument,
    }
    return field(default=default, metadata=metadata)


def names(option: str, value: str) -> tuple[str, ...]:
    """The entries of a comma-separated option, each once. Raises `InputError` where there are none."""
    entries = tuple(dict.fromkeys(entry.strip() for entry in value.split(",") if entry.strip()))
    if not entries:
        raise InputError(f"{option}: expected names with commas between them, got {value!r}")
    return entries


def tracks_of(scenes: LabelledScenes) -> TrackedScenes:
    """The labels' tracks, for writers of results."""
    return [(scene, [frame.tracks for frame in labels]) for scene, labels in scenes]


class ChosenScenes:
    """Scenes of a dataset by their names with commas between them; raises `InputError` for one it does not have."""

    def __init__(self, dataset: Dataset, chosen: str, option: str = "--scenes") -> None:
        self._dataset, self.scenes = dataset, names(option, chosen)
        for name in self.scenes:
            if name not in dataset.scenes:
                raise InputError(f"{option}: {unknown_name('scene', name, dataset.scenes)}")

    def scene(self, name: str) -> Scene:
        """Read one of the scenes."""
        return self._dataset.scene(name)


@dataclass(frozen=True, kw_only=True)
class DatasetSource(ABC):
    """Recordings and how to work with them; the fields are the options that name them. Picklable.

    name            of the dataset, in `saga-fg VERB NAME`
    family          the shipped settings that fit; or the path of a YAML file, over those of "file"
    has_truth       whether there is ground truth
    truth_option    option that names a table of ground truth where there is none otherwise; "" for none
    example         options of the examples in the help
    tracks          what `track` writes, for the help; tracks_example: such a name
    merged          result of all parts in parallel, "" for none: of tracks, of labels
    all_tracks      what holds the tracks of all parts of a parallel run, for `benchmark`; "" for none
    summarised      whether figures have a narrow summary
    """

    name: ClassVar[str]
    family: ClassVar[str | Path] = "file"
    has_truth: ClassVar[bool] = True
    truth_option: ClassVar[str] = ""
    example: ClassVar[str] = ""
    tracks: ClassVar[str] = "Table of tracks to write: .csv, .ndjson or .jsonl."
    tracks_example: ClassVar[str] = "tracks.csv"
    merged: ClassVar[tuple[str, str]] = ("", "")
    all_tracks: ClassVar[str] = ""
    summarised: ClassVar[bool] = False

    @property
    def title(self) -> str:
        """Title of the recordings in reports."""
        return self.name

    @property
    def tracks_suffix(self) -> str:
        """Suffix of the result of one part, in parallel runs."""
        return ".csv"

    @abstractmethod
    def open(self, truth: bool = False) -> AbstractContextManager[Dataset]:
        """The chosen recordings, for the length of a block; with ground truth if there is some and it is wanted."""

    def ground_truth(self) -> AbstractContextManager[Dataset]:
        """The chosen recordings with ground truth of all objects, to learn from it; there may be no frames."""
        return self.open(truth=True)

    def restricted(self, scenes: Collection[str]) -> Self:
        """Recordings of these scenes alone; a dataset may open more than these."""
        return self

    def input_files(self) -> tuple[Path, ...]:
        """Files that the options name, which no result may overwrite."""
        return ()

    def option_for(self, mend: Mend) -> str:
        """The options of the command that mend a suspicion about the recordings; "" where it has none."""
        return ""

    def kept(self) -> Mapping[str, Any]:
        """Options that a result keeps about how its recordings were read: values of JSON."""
        return {}

    def with_kept(self, kept: Mapping[str, Any]) -> Self:
        """The recordings, read as a result says (`kept`) where no option says otherwise."""
        return self

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        """The recordings one by one, for workers; by default scenes that are read here and sent."""
        from data_tools.datasets.parts import HeldScene, Parts

        with self.open() as dataset:
            yield Parts(dataset.scenes, (HeldScene(dataset.scene(name)) for name in dataset.scenes), dataset)

    def stream(self) -> AbstractContextManager[Iterator[Scene]] | None:
        """Recordings as successive parts of scenes, to smooth them while they are read; None to hold each in memory."""
        return None

    def scans(self, scenes: Collection[str]) -> Mapping[str, ScanSequence]:
        """LiDAR scans by scene, of those that have some."""
        return {}

    def maps(self, scenes: Mapping[str, Scene]) -> Mapping[str, AreaMap]:
        """Maps to draw, by scene, of those that have one."""
        return {}

    def images(self, scenes: Mapping[str, Scene]) -> Mapping[str, Images]:
        """Camera images by scene, of those that have some."""
        return {}

    def write_tracks(self, output: Path, dataset: Dataset, scenes: TrackedScenes) -> None:
        """Write the result of tracking; it appears when all is done."""
        from data_tools.datasets.detection_files import write_tracks

        write_tracks(output, scenes)

    def write_labels(self, folder: Path, dataset: Dataset, scenes: LabelledScenes) -> None:
        """Write labels in the dataset's own format to a folder that has the table of labels."""
        return

    def write_track_part(self, folder: Path, stem: str, dataset: Dataset, scenes: TrackedScenes) -> None:
        """Write the result of one part of a parallel run to folder/tracks/STEM.*."""
        self.write_tracks(folder / "tracks" / f"{stem}{self.tracks_suffix}", dataset, scenes)

    def write_label_part(self, folder: Path, stem: str, dataset: Dataset, scenes: LabelledScenes) -> None:
        """Write the labels of one part of a parallel run to folder/*/STEM.*."""
        self.write_labels(folder, dataset, scenes)

    def merge_tracks(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        """Join the results of all parts of a parallel run to the file `merged`."""
        return

    def write_submission(self, output: Path) -> Path | None:
        """Write what the official server takes, beside the tracks of all parts; returns its place, None for none."""
        return None

    def merge_labels(self, output: Path, stems: Sequence[str], dataset: Dataset | None) -> None:
        """Join the labels of all parts of a parallel run to the file `merged`."""
        return

    def read_results(self, result: Path) -> Mapping[str, SceneResult]:
        """The result of any tracker by scene, with ground truth. Raises `InputError` for one missing or broken.

        The scenes are those the result has; where the field `scenes` names some, all of these.
        """
        from data_tools.datasets.results import read_table_results

        named = isinstance(getattr(self, "scenes", None), str)
        with self.open(truth=self.has_truth) as dataset:
            return read_table_results(result, dataset, every_scene=named)

    def evaluate(
        self,
        results: Mapping[str, SceneResult],
        hota: bool = False,
        innovations: Mapping[str, FloatArray] | None = None,
    ) -> Evaluation:
        """Score results that `read_results` has read. innovations: squared distances of the run, by class."""
        from data_tools.evaluation import evaluate_tracks

        return evaluate_tracks([(each.scene, each.found) for each in results.values()], hota, innovations)
