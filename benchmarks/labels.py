"""Labels from detections, and from the tracks of other trackers: as they are, refined, with shuffled identities.

as given    tracks of the method, whose table says which boxes are predictions
refined     `saga-fg smooth --tracks`; shuffled: after the identities of every frame were exchanged at random, so that
            the boxes alone are left; true identities: after they were replaced by those of the true objects
together    both methods' tracks refined to one result
detections  labels from the detections that all of them had, by `saga-fg smooth`; tracked: by `saga-fg track`
headings    of these labels: the share that is turned round, of boxes that match a true object, all and handed out
ellipses    of those handed out: the share of errors of position that they hold, with intervals over objects
doubt       of these labels: how often what they say with a probability is so
corrected   by an annotator who knows the truth and looks at a tenth of their tracks

Errors of labels against the truth, and an annotator who knows the truth and corrects the tracks looked at.

Labels are handed out where P(exists) >= `KEPT`. Their errors, track by track:

    false    a track of which less than half of the boxes is within `GATE` of a true object of any class, of those at
             moments when one that it comes near is annotated: once. An object seen before its annotation begins, far
             away or beside the image, is none
    class    a true track at least half of whose boxes that are at true objects are at those of other classes: once
    join     a change from one true object to another, between boxes that match
    off      a box of a true track that is off by `FAR_OFF` or `TURNED_OFF`, from the true one that it matches
    missed   a visible true box, detected within `GATE`, that no label matches

The annotator looks at tracks and says which exist and of which class they are. Then the scene is solved again, joins
are cut, and the box in the middle of the longest run of boxes that are off is given; twice again where some are left.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.recording_sets import RecordingOptions, RecordingSet, chosen_sets
from benchmarks.runner import Data, Row, Rows, Seed, difference, each, paired_bootstrap, ratio_of_sums
from data_tools.datasets.given_tracks import sensor_names, with_tracks
from data_tools.datasets.results import SceneResult
from data_tools.metrics import LabelErrors, SceneBoxes, error_summary, nees, placed_detections
from data_tools.metrics.scene_boxes import nearest_pairs
from pipelines.config import Method, load_config
from pipelines.smoothing import for_given_tracks, label_model, load_smooth_config, smooth_scene
from pipelines.tracking import TrackedScene, track_scene
from saga_fg.numerics import BoolArray, FloatArray, IntArray, chi_square_quantile, wrap_angle
from saga_fg.smoothing import LabelBuilder, Labels, Probabilities, RecordingLabels
from saga_fg.smoothing.corrections import checked_corrections
from saga_fg.types import Scene, Tracks

KEPT = 0.5
GATE = 2.0  # m
FAR_OFF, TURNED_OFF = 0.5, np.pi / 9  # m and rad


@dataclass(frozen=True, eq=False)
class JudgedLabels:
    """N labels of a scene against its truth.

    found    the labels; truth: the true boxes of classes that are detected
    own      (N,) row of the true box that a label matches, -1 for none; any: of whatever class is near
    off      (N,) whether it is far off it; turned: by more than 90 degrees; kept (N,) whether it is handed out
    missed   (M,) which true boxes are missed
    """

    found: SceneBoxes
    truth: SceneBoxes
    own: IntArray
    any: IntArray
    off: BoolArray
    turned: BoolArray
    kept: BoolArray
    missed: BoolArray

    def tracks(self) -> dict[str, IntArray]:
        """The rows of each track, in order of time."""
        order = np.argsort(self.found.id, kind="stable")
        names, starts = np.unique(self.found.id[order], return_index=True)
        return dict(zip(names.tolist(), np.split(order, starts[1:]), strict=True))

    def is_false(self, rows: IntArray) -> bool:
        """Whether these are the labels of no true object."""
        near = self.any[rows] >= 0
        annotated = self.truth.frame[np.isin(self.truth.id, self.truth.id[self.any[rows[near]]])]
        return not near.any() or bool(near[np.isin(self.found.frame[rows], annotated)].mean() < 0.5)

    def is_class(self, rows: IntArray) -> bool:
        """Whether these are the labels of a true object of their class."""
        return not self.is_false(rows) and bool((self.own[rows[self.any[rows] >= 0]] >= 0).mean() > 0.5)

    def is_other_class(self, rows: IntArray) -> bool:
        """Whether these are the labels of an object of another class."""
        return not self.is_false(rows) and not self.is_class(rows)

    def joins(self, rows: IntArray) -> list[tuple[int, int]]:
        """Pairs of successive rows between which a track changes from one true object to another."""
        rows = rows[self.own[rows] >= 0]
        name = self.truth.id[self.own[rows]]
        changed = name[:-1] != name[1:]
        return [(int(a), int(b)) for a, b in zip(rows[:-1][changed], rows[1:][changed], strict=True)]

    def errors(self) -> dict[str, int]:
        """Numbers of errors by kind."""
        counts = dict.fromkeys(("false", "class", "join", "off", "missed"), 0)
        for rows in self.tracks().values():
            if not self.kept[rows[0]]:
                continue
            if self.is_false(rows):
                counts["false"] += 1
            else:
                counts["class"] += self.is_other_class(rows)
                counts["join"] += len(self.joins(rows))
                counts["off"] += int(self.off[rows].sum())
        counts["missed"] = int(self.missed.sum())
        return counts


def judged(scene: Scene, labels: Sequence[Labels]) -> JudgedLabels:
    """Compare labels with the truth of their scene."""
    assert scene.ground_truth is not None
    found = SceneBoxes.of_tracks([moment.tracks for moment in labels])
    frame, boxes = placed_detections(scene)
    classes = np.unique(np.concatenate([boxes.label, found.boxes.label]))
    truth = SceneBoxes.of_annotations(scene.ground_truth)
    visible = np.concatenate([moment.visible for moment in scene.ground_truth])
    kept = np.concatenate([np.empty(0), *(moment.probability.exists for moment in labels)]) >= KEPT
    own, any_ = np.full(len(found), -1), np.full(len(found), -1)
    row, column, distance = nearest_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), GATE)
    own[column] = row
    off, turned = np.zeros((2, len(found)), dtype=np.bool_)
    angle = np.abs(wrap_angle(truth.boxes.yaw[row] - found.boxes.yaw[column]))
    off[column] = visible[row] & ((distance > FAR_OFF) | (angle > TURNED_OFF))
    turned[column] = angle > np.pi / 2
    alike = [(table.frame, replace(table.boxes, label=np.full(len(table), "any"))) for table in (truth, found)]
    row, column, _ = nearest_pairs(alike[0], alike[1], GATE)
    any_[column] = row
    other = own >= 0
    any_[other] = own[other]
    seen = np.zeros(len(truth), dtype=np.bool_)
    seen[nearest_pairs((truth.frame, truth.boxes), (frame, boxes), GATE)[0]] = True
    matched = np.zeros(len(truth), dtype=np.bool_)
    handed = found.select(np.flatnonzero(kept))
    matched[nearest_pairs((truth.frame, truth.boxes), (handed.frame, handed.boxes), GATE)[0]] = True
    missed = visible & seen & ~matched & np.isin(truth.boxes.label, classes)
    return JudgedLabels(found, truth, own, any_, off, turned, kept, missed)


BINS = (0.0, 0.1, 0.5, 0.9, 1.0)


class Answers:
    """What labels say of objects, and what is so: by question rows of both and a weight."""

    def __init__(self) -> None:
        self.said: dict[str, list[tuple[float, float, float]]] = {}

    def add(self, scene: JudgedLabels, labels: Sequence[Labels]) -> None:
        """Ask whether the objects of a scene exist, and of those that do whether class, identity and heading are
        right; headings count by boxes."""
        p = Probabilities.concatenate([moment.probability for moment in labels])

        def answer(question: str, said: FloatArray, right: float, weight: float = 1.0) -> None:
            self.said.setdefault(question, []).append((float(said[rows[0]]), float(right), float(weight)))

        for rows in scene.tracks().values():
            own = scene.own[rows] >= 0
            answer("exists", p.exists, not scene.is_false(rows))
            if not scene.is_false(rows):
                answer("class", p.label, scene.is_class(rows))
            if scene.is_class(rows):
                answer("identity", p.one, not scene.joins(rows))
                answer("heading", p.heading, 1 - scene.turned[rows][own].mean(), own.sum())

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each question and range of what was said."""
        for question, answers in self.said.items():
            said, true, weight = np.array(answers).reshape(-1, 3).T
            for low, high in pairwise(BINS):
                mine = (said >= low) & ((said < high) | (high == 1.0))
                if mine.any():
                    figures = (float(np.average(column[mine], weights=weight[mine])) for column in (said, true))
                    yield {"question": question, "from": low, "to": high, "objects": int(mine.sum())} | dict(
                        zip(("said", "is"), figures, strict=True)
                    )


RUN = 3  # boxes in a row that are off, from which one is given
LOOKS = 3  # boxes that the annotator gives a track, one after the other, where they are still off


class Annotator:
    """Looks at tracks, knows the truth, and says what is wrong with them."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def looks_at(self, now: JudgedLabels, ids: Iterable[str], whole: bool) -> list[dict[str, Any]]:
        """Corrections of tracks as a whole, else of joins and boxes."""
        tracks = now.tracks()
        rows = [tracks[id_] for id_ in ids if id_ in tracks]
        say = self._whole if whole else self._parts
        return [correction for mine in rows for correction in say(now, mine)]

    def _place(self, now: JudgedLabels, row: int) -> dict[str, Any]:
        (x, y), at = now.found.boxes.position[row, :2].tolist(), float(self._scene.timestamps[now.found.frame[row]])
        return {"time": at, "x": x, "y": y, "label": str(now.found.boxes.label[row])}

    def _whole(self, now: JudgedLabels, rows: IntArray) -> Iterator[dict[str, Any]]:
        """What is wrong with a whole track."""
        matched = rows[now.any[rows] >= 0]
        if now.is_false(rows):
            yield {"what": "exists", "at": self._place(now, int(rows[len(rows) // 2])), "value": False}
            return
        at = self._place(now, int(matched[len(matched) // 2]))
        if not now.kept[rows[0]]:
            yield {"what": "exists", "at": at, "value": True}
        if now.is_other_class(rows):
            names, counts = np.unique(now.truth.boxes.label[now.any[matched]], return_counts=True)
            yield {"what": "class", "at": at, "label": str(names[np.argmax(counts)])}

    def _parts(self, now: JudgedLabels, rows: IntArray) -> Iterator[dict[str, Any]]:
        """What is wrong with some of the boxes."""
        if now.is_false(rows):
            return
        for a, b in now.joins(rows):
            yield {"what": "same", "at": self._place(now, a), "and": self._place(now, b), "value": False}
        off = rows[now.off[rows]]
        if len(off):
            run = max(np.split(off, np.flatnonzero(np.diff(now.found.frame[off]) > 1) + 1), key=len)
            if len(run) < RUN:
                return
            row = int(run[len(run) // 2])
            true = now.truth.boxes.select([now.own[row]])
            (x, y, z), (length, width, height) = true.position[0].tolist(), true.size[0].tolist()
            box = {
                "x": x,
                "y": y,
                "z": z,
                "yaw": float(true.yaw[0]),
                "length": length,
                "width": width,
                "height": height,
            }
            yield {"what": "box", "at": self._place(now, row), "box": box}


@dataclass
class Account:
    """What the annotator did in some scenes: errors before and after; boxes that are off or missing once it is said
    what exists, and after; the corrections that gave a box or a join, and all."""

    before: int = 0
    after: int = 0
    boxes_before: int = 0
    boxes_after: int = 0
    given: int = 0
    corrections: int = 0
    looks: int = 0
    unfit: int = 0

    def figures(self) -> dict[str, float]:
        """The figures of all scenes."""
        mended = (self.boxes_before - self.boxes_after) / max(self.given, 1)
        return {
            "looks": self.looks,
            "corrections": self.corrections,
            "unfit": self.unfit,
            "errors": self.before,
            "gone": 1 - self.after / max(self.before, 1),
            "boxes each": mended,
        }


class Corrected:
    """Labels of scenes as an annotator leaves them, who looks at a tenth of the tracks: of the whole list, or as many
    as a tenth of those handed out; by the list, or at random."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.accounts: dict[str, Account] = {}
        self.seconds: list[tuple[float, float]] = []  # of a single correction, of everything

    def add(self, scene: Scene, builder: LabelBuilder, labels: RecordingLabels, whole: float) -> None:
        """Correct the labels of a scene, which took `whole` seconds."""
        before, review = judged(scene, moments_of(labels)), labels.review(0.0)
        ids = review.id.astype(np.str_)
        handed = int((review.probability.exists >= KEPT).sum())
        out = ids[review.probability.exists >= KEPT]
        tenth = max(1, round(handed / 10))
        ways = {
            "a tenth of the list, first": ids[: round(len(ids) / 10)],
            "a tenth of the list, random": self._rng.choice(ids, round(len(ids) / 10), replace=False),
            "a tenth of those handed out, first": ids[:tenth],
            "a tenth of those handed out, random": self._rng.choice(out, tenth, replace=False),
        }
        for way, chosen in ways.items():
            self._annotate(way, scene, builder, before, chosen.tolist())
        annotator = Annotator(scene)
        for id_ in ids[:3].tolist():
            one = checked_corrections(
                [one for whole in (False, True) for one in annotator.looks_at(before, [id_], whole)][:1]
            )
            start = time.perf_counter()
            builder.corrected(one)
            self.seconds.append((time.perf_counter() - start, whole))

    def _annotate(self, way: str, scene: Scene, builder: LabelBuilder, before: JudgedLabels, ids: list[str]) -> None:
        annotator, account, now = Annotator(scene), self.accounts.setdefault(way, Account()), before
        records: list[dict[str, Any]] = []
        errors = [before.errors()]
        for look in range(1 + LOOKS):
            records += annotator.looks_at(now, ids, whole=look == 0)
            if records:
                labels, _ = builder.corrected(checked_corrections(records))
                now = judged(scene, moments_of(labels))
            errors.append(now.errors())
        account.before += sum(errors[0].values())
        account.after += sum(errors[-1].values())
        account.boxes_before += errors[1]["off"] + errors[1]["missed"]
        account.boxes_after += errors[-1]["off"] + errors[-1]["missed"]
        account.given += sum(record["what"] in ("box", "same") for record in records)
        account.corrections += len(records)
        account.looks += len(ids)
        account.unfit += sum(why != "" for _, why in builder.outcomes) if records else 0

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each way to choose the tracks, and the time from a correction to new labels."""
        seconds, whole = np.median(np.array(self.seconds), axis=0).tolist()
        for way, account in self.accounts.items():
            yield {"looked at": way, **account.figures(), "seconds": seconds, "of whole": seconds / whole}


def moments_of(labels: RecordingLabels) -> list[Labels]:
    """The labels of all moments."""
    return [moment for part in labels for moment in part]


METHODS: tuple[Method, ...] = ("centerpoint", "kf")
GRAPH: Method = "saga"


def labels(*, data: Data = None, recorded: RecordingOptions, seed: Seed = 0) -> Rows:
    """Refine the tracks of the methods centerpoint and kf, and label the same detections.

    \b
    Examples:
      python -m benchmarks labels --sets simulated --scenes 4
      python -m benchmarks labels --data data --sets megvii,centerpoint,kitti
    """
    for recordings in chosen_sets(recorded.sets, data, recorded.scenes, recorded.test, recorded.viewpoint):
        yield from set_rows(recordings, seed)


def set_rows(recordings: RecordingSet, seed: int) -> Iterable[Row]:
    """A row for each way to the labels."""
    runs: dict[str, dict[str, TrackedScene]] = {}
    online, offline = load_config(recordings.family), load_smooth_config(recordings.family)
    rng, answers, judgements = np.random.default_rng(seed), Answers(), list[JudgedLabels]()
    corrected = Corrected(np.random.default_rng(seed))
    for name in each(recordings.dataset.scenes, recordings.name):
        scene = recordings.scene(name)
        given: dict[str, SceneResult] = {}
        for method in (GRAPH, *METHODS):
            run = track_scene(scene, online.of_method(method).new_tracker(method))
            runs.setdefault("detections, tracked" if method == GRAPH else f"{method}, as given", {})[name] = run
            coasting = np.concatenate([each.coasting for each in run.tracks])
            given[method] = SceneResult(scene, SceneBoxes.of_tracks(run.tracks), coasting=coasting)
        del given[GRAPH]
        start = time.perf_counter()
        builder = LabelBuilder(offline.tracking.new_tracker(GRAPH), label_model(offline, GRAPH))
        builder.add(scene.frames, scene.timestamps)
        made, _ = builder.finish()
        corrected.add(scene, builder, made, time.perf_counter() - start)
        moments = moments_of(made)
        judgements.append(judged(scene, moments))
        answers.add(judgements[-1], moments)
        runs.setdefault("detections, labels", {})[name] = as_run(scene, [moment.tracks for moment in moments])
        wanted = {f"{method}, refined": [result] for method, result in given.items()}
        wanted |= {f"{method}, shuffled": [shuffled(result, rng)] for method, result in given.items()}
        wanted |= {f"{method}, true identities": [truly_named(result)] for method, result in given.items()}
        for variant, results in (wanted | {"together, refined": list(given.values())}).items():
            settings = for_given_tracks(offline, [{name: result} for result in results])
            named = dict(zip(sensor_names(len(results)), results, strict=True))
            labelled = smooth_scene(with_tracks(named, replace(scene, frames=())), settings)
            runs.setdefault(variant, {})[name] = as_run(scene, labelled.tracks)
    for variant, found in sorted(runs.items()):
        yield f"{recordings.name}: {len(found)} scenes", {"labels": variant, **figures(recordings, found)}
    for row in heading_rows(judgements):
        yield f"{recordings.name}: headings", row
    for row in ellipse_rows(judgements):
        yield f"{recordings.name}: errors within the ellipses", row
    for row in answers.rows():
        yield f"{recordings.name}: doubt", row
    for row in corrected.rows():
        yield f"{recordings.name}: corrected", row


def heading_rows(scenes: Sequence[JudgedLabels]) -> Iterable[dict[str, Any]]:
    """A row for each class."""
    matches = [scene.own >= 0 for scene in scenes]
    label = np.concatenate([scene.found.boxes.label[rows] for scene, rows in zip(scenes, matches, strict=True)])
    turned, kept = (
        np.concatenate([getattr(scene, name)[rows] for scene, rows in zip(scenes, matches, strict=True)])
        for name in ("turned", "kept")
    )
    for name in np.unique(label).tolist():
        mine = label == name
        handed = mine & kept
        shares = {"all": turned[mine].mean(), "handed out": turned[handed].mean() if handed.any() else np.nan}
        yield {"class": name, "boxes": int(mine.sum()), "of them handed out": int(handed.sum()), **shares}


HELD = (0.5, 0.9)  # what ellipses should hold
FEWEST = 100  # boxes of a class that is shown


def ellipse_rows(scenes: Sequence[JudgedLabels]) -> Iterator[dict[str, Any]]:
    """A row for each class and for all, of labels handed out that match a true object: shares with 95 % intervals over
    objects."""
    found: list[tuple[str, FloatArray]] = []  # of each true object: its class, squared errors
    for scene in scenes:
        rows = np.flatnonzero(scene.kept & (scene.own >= 0))
        error = scene.found.boxes.position[rows, :2] - scene.truth.boxes.position[scene.own[rows], :2]
        squared, object_of = nees(error, scene.found.position_covariance[rows]), scene.truth.id[scene.own[rows]]
        for name in np.unique(object_of).tolist():
            mine = object_of == name
            found.append((str(scene.found.boxes.label[rows[mine][0]]), squared[mine & np.isfinite(squared)]))
    for label in ("all", *sorted({label for label, _ in found})):
        chosen = [squared for each, squared in found if label in ("all", each)]
        if (boxes := sum(map(len, chosen))) < FEWEST:
            continue
        shares = {
            f"in {100 * p:g} %": paired_bootstrap(
                [((squared <= chi_square_quantile(p, 2)).sum(), len(squared)) for squared in chosen],
                [(0, 1)] * len(chosen),
                ratio_of_sums,
                difference,
                draws=1000,
            )
            for p in HELD
        }
        yield {"class": label, "objects": len(chosen), "boxes": boxes, **shares}


def as_run(scene: Scene, tracks: Sequence[Tracks]) -> TrackedScene:
    """Labels as a tracker's output."""
    return TrackedScene(scene, tuple(tracks), ())


def figures(recordings: RecordingSet, found: Mapping[str, TrackedScene]) -> dict[str, float]:
    """The figures of a set, and the errors at labels, m and m/s."""
    score = recordings.score(found)
    errors = error_summary(LabelErrors.pool(score.errors))
    return {**score.figures_of(range(len(found))), "position": errors.position, "velocity": errors.velocity}


def shuffled(result: SceneResult, rng: np.random.Generator) -> SceneResult:
    """The result with the identities of each frame exchanged at random."""
    found = result.found
    order = np.lexsort((rng.random(len(found)), found.frame))
    return replace(result, found=replace(found, id=found.id[order]))


def truly_named(result: SceneResult) -> SceneResult:
    """The result with the identities of the true objects that its boxes match: the most that identities can do."""
    found, truth = result.found, SceneBoxes.of_annotations(result.scene.ground_truth or ())
    row, column, _ = nearest_pairs((truth.frame, truth.boxes), (found.frame, found.boxes), GATE)
    name = np.char.add("of the tracker ", found.id).astype("U64")
    name[column] = truth.id[row]
    return replace(result, found=replace(found, id=name))
