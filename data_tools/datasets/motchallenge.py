"""Sequences of MOTChallenge: boxes in the images of a camera that stands still above flat ground.

    SEQUENCE/det/det.txt    frame, -1, left, top, width, height, score, ...     px; frames count from 1
    SEQUENCE/gt/gt.txt      frame, id, left, top, width, height, counts, class, visibility
    SEQUENCE/seqinfo.ini    frameRate, seqLength

and results NAME.txt: frame, id, left, top, width, height, score, -1, -1, -1. Boxes are pedestrians, true ones those
that count and are of class 1.

Source: Milan et al., MOT16: A Benchmark for Multi-Object Tracking, 2016, section 3.3.
"""

from __future__ import annotations

import configparser
import io
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_tools.datasets.detection_files import write_tracks
from data_tools.datasets.results import Results, SceneResult, clear_figures
from data_tools.datasets.source import (
    ChosenScenes,
    DatasetSource,
    ResultFormat,
    TrackedScenes,
    option,
)
from data_tools.files import atomic_directory, read_text, write_text
from data_tools.metrics import SceneBoxes, SceneSimilarities, image_overlaps, similarity_metrics
from saga_fg.errors import InputError, error_context
from saga_fg.model import GroundCamera
from saga_fg.numerics import FloatArray, IntArray, refuse
from saga_fg.types import Annotations, Frame, Scene, Tracks

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation

log = logging.getLogger(__name__)
PEDESTRIAN = "pedestrian"
TABLE = "tracks.csv"
LARGEST = 10**6  # frame, id, pixel


@dataclass(frozen=True, eq=False)
class ImageRows:
    """Rows of a file: frame (N,) from 0, ascending; id (N,); xyxy (N, 4), px; the columns from the seventh on."""

    frame: IntArray
    id: IntArray
    xyxy: FloatArray
    further: FloatArray

    @classmethod
    def read(cls, path: Path) -> ImageRows:
        """Read a file of boxes. Raises `InputError` naming file and row."""
        expected = (
            f"{path}: expected rows of at least 7 numbers with commas: frame, id, left, top, width, height, score"
        )
        text = read_text(path)
        try:
            rows = (
                np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2, comments=None)
                if text.strip()
                else np.empty((0, 7))
            )
        except ValueError as error:
            raise InputError(f"{expected}: {error}") from error
        if rows.shape[1] < 7:
            raise InputError(f"{expected}; got {rows.shape[1]}")
        bad = ~np.isfinite(rows).all(axis=1) | (rows[:, 0] < 1) | (rows[:, :2] != np.rint(rows[:, :2])).any(axis=1)
        bad |= (rows[:, 4:6] <= 0).any(axis=1) | (np.abs(rows[:, :6]) > LARGEST).any(axis=1)
        what = f"a whole frame from 1 on, a whole id, and a box of a width and height above 0, all within {LARGEST:g}"
        refuse(bad, lambda row: InputError(f"{path}: row {row + 1}: expected {what}, got {rows[row].tolist()}"))
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        xyxy = np.concatenate([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]], axis=1)
        return cls(rows[:, 0].astype(np.int64) - 1, rows[:, 1].astype(np.int64), xyxy, rows[:, 6:])

    def by_frame(self, count: int) -> list[IntArray]:
        """The rows of each of the first frames."""
        return np.split(np.arange(len(self.frame)), np.searchsorted(self.frame, np.arange(1, count)))


class MotSequences:
    """The sequences of a folder, or the folder itself as one."""

    def __init__(self, folder: Path, camera: GroundCamera, truth: bool, chosen: str | None = None) -> None:
        places = [folder, *sorted(folder.glob("*"))]
        self._places = {place.resolve().name: place for place in places if (place / "det" / "det.txt").is_file()}
        if not self._places:
            raise InputError(f"{folder}: expected sequences with det/det.txt, there are none")
        self.scenes, self.camera, self._truth = tuple(self._places), camera, truth
        if chosen is not None:
            self.scenes = ChosenScenes(self, chosen).scenes

    def files(self, name: str) -> tuple[Path, Path]:
        """Detections and facts of a sequence."""
        return self._places[name] / "det" / "det.txt", self._places[name] / "seqinfo.ini"

    def truth(self, name: str) -> ImageRows:
        """The true boxes that count."""
        rows = ImageRows.read(self._places[name] / "gt" / "gt.txt")
        counts = np.flatnonzero((rows.further[:, 0] != 0) & ((rows.further[:, 1:2] == 1).all(axis=1)))
        return ImageRows(rows.frame[counts], rows.id[counts], rows.xyxy[counts], rows.further[counts])

    def scene(self, name: str) -> Scene:
        """Read a sequence. Raises `InputError` naming the file of what is wrong."""
        (boxes, facts), camera = self.files(name), self.camera
        found, (rate, length) = ImageRows.read(boxes), _sequence_facts(facts)
        count = max(length, int(found.frame.max(initial=-1)) + 1)
        times, frames = np.arange(count) / rate, []
        for time, rows in zip(times.tolist(), found.by_frame(count), strict=True):
            label = np.full(len(rows), PEDESTRIAN)
            frames.append(Frame(time, "camera", camera.detections(found.xyxy[rows], found.further[rows, 0], label)[0]))
        if lost := len(found.frame) - sum(map(len, frames)):
            log.warning("%s: %d of %d boxes left out: they end above the horizon", boxes, lost, len(found.frame))
        truth = self._annotations(name, count) if self._truth else None
        return Scene(name, times, frames=frames, ground_truth=truth)

    def _annotations(self, name: str, count: int) -> list[Annotations]:
        true, moments = self.truth(name), []
        for rows in true.by_frame(count):
            placed, of = self.camera.detections(true.xyxy[rows], np.ones(len(rows)), np.full(len(rows), PEDESTRIAN))
            visible = true.further[rows[of], 2] > 0 if true.further.shape[1] > 2 else np.ones(len(of), bool)
            moments.append(Annotations(true.id[rows[of]].astype(np.str_), placed.boxes, visible))
        return moments


def _sequence_facts(path: Path) -> tuple[float, int]:
    """Frames per second, and their number. Raises `InputError` for a file without them."""
    facts = configparser.ConfigParser()
    try:
        facts.read_string(read_text(path))
        rate, length = facts.getfloat("Sequence", "frameRate"), facts.getint("Sequence", "seqLength")
    except (configparser.Error, ValueError) as error:
        raise InputError(
            f"{path}: expected frameRate and seqLength of a [Sequence]: {str(error).splitlines()[0]}"
        ) from error
    if not (1 / LARGEST <= rate <= LARGEST and 0 < length <= LARGEST):
        raise InputError(
            f"{path}: expected numbers from {1 / LARGEST:g} to {LARGEST:g}, got frameRate {rate:g}, seqLength {length}"
        )
    return rate, length


class MotFormat(ResultFormat):
    """Text of the benchmark's format, and a table."""

    tracks = "Folder to write: NAME.txt in the benchmark's format, tracks.csv with places, velocities and covariances."
    tracks_example = "results"
    all_tracks = "tracks"
    submission = "tracks/*.txt"

    def write_tracks(self, output: Path, dataset: MotSequences, scenes: TrackedScenes) -> None:
        with atomic_directory(output, known=(TABLE, *(f"{name}.txt" for name in dataset.scenes))) as folder:
            self.write_track_part(folder / TABLE, dataset, scenes)

    def write_track_part(self, part: Path, dataset: MotSequences, scenes: TrackedScenes) -> None:
        kept = list(scenes)
        write_tracks(part, kept)
        for scene, moments in kept:
            write_text(part.with_name(f"{scene.name}.txt"), result_text(moments, dataset.camera))


def result_text(moments: Sequence[Tracks], camera: GroundCamera) -> str:
    """The lines of a result; tracks that have no box in the image are left out."""
    lines = []
    for number, tracks in enumerate(moments, start=1):
        boxes = camera.image_boxes(tracks.boxes)
        for k in np.flatnonzero(np.isfinite(boxes).all(axis=1)):
            left, top, right, low = boxes[k]
            box = f"{left:.2f},{top:.2f},{right - left:.2f},{low - top:.2f}"
            lines.append(f"{number},{tracks.id[k]},{box},{tracks.score[k]:.4f},-1,-1,-1\n")
    return "".join(lines)


@dataclass(frozen=True, eq=False)
class MotResult(SceneResult):
    """A sequence: also the boxes of the result and of the truth in the image."""

    result: ImageRows
    truth: ImageRows | None

    def similarities(self) -> SceneSimilarities:
        """Overlaps of true and found boxes in the image, by frame."""
        assert self.truth is not None
        true, found, count = self.truth, self.result, len(self.scene)
        pairs = list(zip(true.by_frame(count), found.by_frame(count), strict=True))
        overlaps = [image_overlaps(true.xyxy[a], found.xyxy[b]) for a, b in pairs]
        return SceneSimilarities([true.id[a] for a, _ in pairs], [found.id[b] for _, b in pairs], overlaps)


def evaluate_mot(
    scenes: Mapping[str, MotResult], hota: bool = False, innovations: Mapping[str, FloatArray] | None = None
) -> Evaluation:
    """Score tracks on the ground; and in the image by HOTA, CLEAR and Identity, where trackeval is installed."""
    from data_tools.evaluation import HotaRow

    evaluation = clear_figures(scenes, innovations=innovations)
    if not hota and find_spec("trackeval") is None:
        return evaluation
    figures = similarity_metrics([each.similarities() for each in scenes.values()])
    return replace(evaluation, hota=[HotaRow(PEDESTRIAN, "image", 0.0, figures)])


@dataclass(frozen=True, kw_only=True)
class MotChallengeSource(DatasetSource):
    """Sequences of MOTChallenge, of a camera that stands still above flat ground.

    The camera is a YAML file: `homography`, or `focal_length`, `centre`, `height`, `pitch` and more.
    """

    name = "motchallenge"
    written = MotFormat()
    example = "MOT17/train --camera camera.yaml"
    folder: str = option("Folder of a sequence, or of several.", metavar="FOLDER", argument=True)
    camera: GroundCamera = option("YAML file of the camera.", metavar="FILE")
    scenes: str | None = option("Names of sequences with commas between them; all if left out.", None)

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[MotSequences]:
        yield MotSequences(Path(self.folder), self.camera, truth, self.scenes)

    def read_results(self, result: Path, truth: bool = True) -> Results:
        with self.open(truth) as dataset:
            there = {name: result / f"{name}.txt" for name in dataset.scenes if (result / f"{name}.txt").is_file()}
            if not there:
                raise InputError(
                    f"{result}: expected a folder with results NAME.txt of {', '.join(dataset.scenes[:6])}"
                )
            return Results({name: _result(dataset, name, path, truth) for name, path in there.items()}, evaluate_mot)


def _result(dataset: MotSequences, name: str, path: Path, truth: bool) -> MotResult:
    rows, scene = ImageRows.read(path), dataset.scene(name)
    if rows.frame.max(initial=-1) >= len(scene):
        raise InputError(f"{path}: frame {rows.frame.max() + 1}: expected frames 1 to {len(scene)} only")
    score = rows.further[:, 0]
    placed, of = dataset.camera.detections(rows.xyxy, score, np.full(len(score), PEDESTRIAN))
    with error_context(str(path)):
        found = SceneBoxes(rows.frame[of], rows.id[of].astype(np.str_), placed.boxes, score[of])
    return MotResult(scene, found, rows, dataset.truth(name) if truth else None)
