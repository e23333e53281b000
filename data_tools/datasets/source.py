"""A dataset for all verbs of the command, and datasets by name.

It says its options, how it opens, how its results are written and read.

A new dataset is a dataclass derived from `DatasetSource`, whose fields are its options:

    @dataclass(frozen=True, kw_only=True)
    class Mine(DatasetSource):
        "My recordings, a folder each."

        name = "mine"
        folder: str = option("Folder of the recordings, or its URL.")

        @property
        def scenes(self) -> tuple[str, ...]:
            return tuple(sorted(path.stem for path in Path(self.folder).glob("*.json")))

        def scene(self, name: str) -> Scene:
            return read_recording(Path(self.folder, f"{name}.json"))

Everything else has a default: tables of tracks and labels as results, scored by CLEAR figures and RMSE.

Datasets by name: those that come along, those of installed packages, and MODULE:CLASS.

A package offers a `DatasetSource` through the entry point group `saga_fg.datasets`:

    [project.entry-points."saga_fg.datasets"]
    mine = "my_package.my_module:Mine"
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, cast

import numpy as np

from data_tools.files import open_bytes
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import FloatArray, refuse
from saga_fg.parts import find, names_of, part_kind
from saga_fg.types import Dataset, Scene

if TYPE_CHECKING:
    from data_tools.datasets.results import Results
    from data_tools.lidar import ScanSequence
    from saga_fg.smoothing import Labels
    from saga_fg.types import Tracks

Verb = Literal[
    "track", "smooth", "evaluate", "evaluate labels", "benchmark", "report", "view", "learn noise", "learn interactions"
]

GROUP = "saga_fg.datasets"

TRACKING: tuple[Verb, ...] = ("track", "evaluate labels", "benchmark", "learn noise")
"""Verbs that need detections; `smooth` takes tracks as well."""

TrackedScenes = Iterable[tuple[Scene, Sequence["Tracks"]]]
"""Scenes with one `Tracks` for each of their timestamps."""

Images = Mapping[str, Sequence[Path | None]]
"""Image files by camera, for each moment of a scene."""

Innovations = Mapping[str, "FloatArray"]
"""Squared distances of tracks and the detections they took, in sigmas, by class."""

LabelledScenes = Iterable[tuple[Scene, Sequence["Labels"]]]
"""Scenes with one `Labels` for each of their timestamps."""


@dataclass(frozen=True, eq=False)
class OpenedPart:
    """A part at hand: the SHA-256 of each of its inputs by name, and how to read it as a dataset."""

    digests: Mapping[str, str]
    read: Callable[[], Dataset]


@dataclass(frozen=True, eq=False)
class Part:
    """One scene, or a file of several, that is sent to a worker by pickling.

    name    unique within a run; results and the manifest are named for it
    opened  makes the part available for the length of a block; raises `InputError` where it is not
    """

    name: str
    opened: Callable[[], AbstractContextManager[OpenedPart]]


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a dataset, by name, and the dataset they come from if it is open."""

    names: Sequence[str]
    parts: Iterable[Part]
    dataset: Dataset | None = None


@dataclass(frozen=True, eq=False)
class HeldScene:
    """A scene in memory; a dataset of itself. Its inputs are its moments, the frames of each sensor, and `meta`, what
    else results depend on."""

    held: Scene
    meta: Any = None

    @property
    def part(self) -> Part:
        """The scene to be sent."""
        return Part(self.held.name, self.opened)

    @property
    def scenes(self) -> tuple[str, ...]:
        """The one name."""
        return (self.held.name,)

    def scene(self, name: str) -> Scene:
        """The scene; raises `InputError` for another name."""
        if name != self.held.name:
            raise InputError(f"scene {name!r}: expected {self.held.name}")
        return self.held

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digests of everything in the scene but its ground truth."""
        about = {} if self.meta is None else {"meta": hashlib.sha256(repr(self.meta).encode()).hexdigest()}
        yield OpenedPart({**scene_digests(self.held), **about}, lambda: self)


def scene_digests(scene: Scene) -> dict[str, str]:
    """SHA-256 of a scene's moments and of the frames of each sensor: of all that its results can depend on."""
    moments = hashlib.sha256(repr((scene.name, scene.tokens)).encode())
    for array in (scene.timestamps, scene.world_T_ego):
        moments.update(np.ascontiguousarray(array).tobytes())
    maps = {id(frame.road_map): frame.road_map for frame in scene.frames}  # most bring the same
    moments.update(repr(list(maps.values())).encode())
    digests = {"moments": moments.hexdigest()}
    for sensor in scene.sensors:
        frames = hashlib.sha256()
        for frame in scene.frames:
            if frame.sensor != sensor:
                continue
            boxes = frame.detections.boxes
            frames.update(repr((frame.timestamp, frame.coordinates, frame.token, boxes.label.tolist())).encode())
            pose = np.empty(0) if frame.world_T_ego is None else frame.world_T_ego
            frames.update(frame.detections.identity.tobytes())
            for array in (pose, boxes.position, boxes.size, boxes.yaw, boxes.velocity, frame.detections.score):
                frames.update(np.ascontiguousarray(array).tobytes())
        digests[sensor] = frames.hexdigest()
    return digests


@contextmanager
def opened_recording(source: DatasetSource, name: str) -> Iterator[OpenedPart]:
    """Open one recording, with the digests of the `files` that the dataset reads it from, and settings of options."""
    settings = {field.name: getattr(source, field.name) for field in fields(source)}
    texts = {name: repr(value) for name, value in settings.items() if is_dataclass(value)}
    with source.open() as dataset:
        files: Iterable[Path] = dataset.files(name)  # type: ignore[attr-defined]
        digests = {f"{path.parent.name}/{path.name}": file_digest(path) for path in files}
        yield OpenedPart({**digests, **texts}, lambda: dataset)


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open_bytes(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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

    def true_scene(self, name: str) -> Scene:
        """Read one of the scenes with all its objects, see `true_scene`."""
        return true_scene(self._dataset, name)


def true_scene(dataset: Dataset, name: str) -> Scene:
    """A scene to learn from: with all objects, seen or not, of a dataset that has `true_scene`, else as it is."""
    read: Callable[[str], Scene] = getattr(dataset, "true_scene", dataset.scene)
    return read(name)


@dataclass(frozen=True)
class Surroundings:
    """LiDAR scans, maps to draw and camera images, by scene, of those that have some; read when they are called."""

    scans: Callable[[], Mapping[str, ScanSequence]] = dict
    maps: Callable[[], Mapping[str, AreaMap]] = dict
    images: Callable[[], Mapping[str, Images]] = dict


def input_files(source: DatasetSource) -> tuple[Path, ...]:
    """Files that the options of a dataset name, as FILE or NAME=FILE, which no result may overwrite."""
    values = [getattr(source, each.name) for each in fields(source)]
    texts = [text for value in values for text in (value if isinstance(value, list) else [value])]
    places = [place for text in texts if isinstance(text, str) for place in (text, text.partition("=")[2])]
    return tuple(Path(place) for place in places if os.path.isfile(place))  # noqa: PTH113 (stands any text)


def require_measured(tracks: Tracks, where: str) -> None:
    """Raise `InputError` for a track without a size or heading, for formats that hold boxes alone."""
    unmeasured = ~np.isfinite(tracks.boxes.size).all(axis=1) | ~np.isfinite(tracks.boxes.yaw)
    expected = "expected a known size and heading, the format requires them"
    refuse(unmeasured, lambda row: InputError(f"{where}: track {tracks.id[row]}: {expected}"))


class ResultFormat:
    """How results are written: tables, if nothing else is said.

    tracks       what `track` writes, for the help; tracks_example: such a name
    merged       result of all parts in parallel, "" for none: of tracks, of labels
    all_tracks   what holds the tracks of all parts of a parallel run, for `benchmark`; "" for none
    submission   pattern of the files that the official server takes, "" for none
    classes      that labels may have, () for any

    Methods take a dataset that the `DatasetSource` of this format has opened.
    """

    tracks = "Table of tracks to write: .csv, .ndjson, .jsonl or .parquet (extra [parquet])."
    tracks_example = "tracks.csv"
    merged = ("", "")
    all_tracks = ""
    submission = ""
    classes: tuple[str, ...] = ()

    def write_tracks(self, output: Path, dataset: Any, scenes: TrackedScenes) -> None:
        """Write the result of tracking; it appears when all is done."""
        from data_tools.datasets.detection_files import write_tracks

        write_tracks(output, scenes)

    def write_labels(self, folder: Path, dataset: Any, scenes: LabelledScenes, part: str = "") -> None:
        """Write labels in the dataset's own format to a folder that has the table of labels.

        part  name of a part of a parallel run, whose files go to folder/*/PART.*
        """
        return

    def write_track_part(self, part: Path, dataset: Any, scenes: TrackedScenes) -> None:
        """Write the result of one part of a parallel run, which is named for a file in a folder of its own."""
        self.write_tracks(part, dataset, scenes)

    def merge(self, output: Path, stems: Sequence[str], dataset: Any, labels: bool) -> None:
        """Join the tracks, or labels, of all parts of a parallel run to the file `merged`."""
        return


@part_kind("dataset", GROUP)
@dataclass(frozen=True, kw_only=True)
class DatasetSource:
    """Recordings and how to work with them; the fields are the options that name them. Picklable.

    name            of the dataset, in `saga-fg VERB NAME`
    family          the shipped settings that fit; or the path of a YAML file, over those of "file"
    has_truth       whether there is ground truth
    truth_option    option that names a table of ground truth where there is none otherwise; "" for none
    example         options of the examples in the help
    written         how results are written
    summarised      whether figures have a narrow summary
    shows           of scans, maps and images, those that `surroundings` may have
    """

    name: ClassVar[str]
    family: ClassVar[str | Path] = "file"
    has_truth: ClassVar[bool] = True
    truth_option: ClassVar[str] = ""
    example: ClassVar[str] = ""
    written: ClassVar[ResultFormat] = ResultFormat()
    summarised: ClassVar[bool] = False
    shows: ClassVar[tuple[Literal["scans", "maps", "images"], ...]] = ()

    def __str__(self) -> str:
        """Title of the recordings in reports."""
        return self.name

    def open(self, truth: bool = False) -> AbstractContextManager[Dataset]:
        """The chosen recordings, for the length of a block; with ground truth if there is some and it is wanted.

        By default the source is its own dataset, with `scenes` and `scene(name)`. Where a dataset has
        `true_scene(name)`, it is asked for all objects, seen or not, to learn from them; there may be no frames.
        """
        if not hasattr(self, "scene"):
            raise InputError(f"dataset: {type(self).__name__}: expected scenes and scene(name), or open")
        return nullcontext(cast(Dataset, self))

    def restricted(self, scenes: Collection[str]) -> Self:
        """Recordings of these scenes alone, if `scenes` is an option; a dataset may open more than these."""
        chosen: dict[str, Any] = {each.name: ",".join(scenes) for each in fields(self) if each.name == "scenes"}
        return replace(self, **chosen)

    def kept(self) -> Mapping[str, Any]:
        """Options that a result keeps about how its recordings were read: values of JSON."""
        return {}

    def with_kept(self, kept: Mapping[str, Any]) -> Self:
        """The recordings, read as a result says (`kept`) where no option says otherwise."""
        return self

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        """The recordings one by one, for workers.

        By default scenes are read here and sent; those of a dataset that has a method `files` are read by the worker.
        """
        with self.open() as dataset:
            scenes = dataset.scenes
            if callable(getattr(dataset, "files", None)):
                yield Parts(
                    scenes, (Part(name, partial(opened_recording, self.restricted([name]), name)) for name in scenes)
                )
            else:
                yield Parts(scenes, (HeldScene(dataset.scene(name)).part for name in scenes), dataset)

    def stream(self) -> AbstractContextManager[Iterator[Scene]] | None:
        """Recordings as successive parts of scenes, to smooth them while they are read; None to hold each in memory."""
        return None

    def surroundings(self, scenes: Mapping[str, Scene]) -> Surroundings:
        """Scans, maps and images of the scenes, of the kinds in `shows`."""
        return Surroundings()

    def read_results(self, result: Path, truth: bool = True) -> Results:
        """The result of any tracker by scene, which scores itself where there is ground truth.

        Raises `InputError` for one missing or broken.

        The scenes are those the result has; where the field `scenes` names some, all of these. truth: with ground
        truth, if there is some
        """
        from data_tools.datasets.detection_files import read_tracks
        from data_tools.datasets.results import Results, table_results

        named = isinstance(getattr(self, "scenes", None), str)
        with self.open(truth=truth and self.has_truth) as dataset:
            return Results(table_results(read_tracks(result, lenient=True), result, dataset, every_scene=named))


Kind = Literal["drivable", "walkway", "crossing"]
REACH = 120.0
"""Distance to the path of the vehicle, along x and y, up to which a map is kept, m."""


@dataclass(frozen=True, eq=False)
class AreaMap:
    """Areas and lines in world coordinates, m.

    areas  kind, and rings (N, 2): where rings of an area overlap, there is a hole
    lines  (N, 2) borders of lanes
    """

    areas: Sequence[tuple[Kind, Sequence[FloatArray]]]
    lines: Sequence[FloatArray]

    @classmethod
    def around(
        cls, scene: Scene, areas: Iterable[tuple[Kind, Sequence[FloatArray]]], lines: Iterable[FloatArray]
    ) -> Self:
        """Return the parts near the path of a scene, cut where they leave its surroundings."""
        path = scene.world_T_ego[:, :2, 3]
        low, high = path.min(axis=0) - REACH, path.max(axis=0) + REACH
        cut = ((kind, [piece for ring in rings if len(piece := clipped(ring, low, high))]) for kind, rings in areas)
        near = [line for line in lines if ((line >= low) & (line <= high)).all(axis=1).any()]
        return cls([area for area in cut if area[1]], near)


def map_points(points: Sequence[Sequence[float]]) -> FloatArray:
    """Points (N, 2) of a map. Raises `ValueError` for points that are not finite."""
    array = np.array(points, dtype=np.float64).reshape(-1, 2)
    if not np.isfinite(array).all():
        raise ValueError("points that are not finite")
    return array


def clipped(ring: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the part of a ring (N, 2) inside a rectangle, as a ring, empty for none (Sutherland and Hodgman, 1974)."""
    for axis in (0, 1):
        for sign, bound in ((1.0, high[axis]), (-1.0, -low[axis])):
            if not len(ring):
                return ring
            room = bound - sign * ring[:, axis]  # negative outside
            nxt, room_next = np.roll(ring, -1, axis=0), np.roll(room, -1)
            inside = room >= 0
            crosses = inside != (room_next >= 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                cut = ring + (room / (room - room_next))[:, None] * (nxt - ring)
            points = np.stack([ring, cut], axis=1)
            ring = points[np.stack([inside, crosses], axis=1)]
    return ring


BUILT_IN: Mapping[str, str] = {
    "nuscenes": "data_tools.datasets.nuscenes.source:NuScenesSource",
    "kitti": "data_tools.datasets.kitti.source:KittiSource",
    "argoverse2": "data_tools.datasets.argoverse2.source:ArgoverseSource",
    "motchallenge": "data_tools.datasets.motchallenge:MotChallengeSource",
    "mcap": "data_tools.datasets.mcap.source:McapSource",
    "file": "data_tools.datasets.detection_file_source:DetectionFileSource",
    "simulated": "data_tools.simulator.world:SimulatedSource",
}


def dataset_names() -> tuple[str, ...]:
    """The names of all datasets, those that come along first."""
    return names_of(GROUP, BUILT_IN)


def dataset_source(name: str) -> type[DatasetSource]:
    """The dataset of a name, or of MODULE:CLASS.

    Raises `InputError` for an unknown name, a name that several packages give, and for what cannot be imported or is no
    dataset, naming the package.
    """
    found: type[DatasetSource] = find("dataset", name, GROUP, BUILT_IN)
    if not (isinstance(found, type) and issubclass(found, DatasetSource)):
        raise InputError(f"dataset: {name}: expected a class derived from DatasetSource, got {found!r:.60}")
    return found
