"""Files of corrections, what became of them, and corrections found in labels that were edited in a tool.

A file has a line of JSON for each:

    {"what": "exists", "at": PLACE, "value": false}            the object at a place does not exist, or does (true)
    {"what": "class", "at": PLACE, "label": "bus"}
    {"what": "same", "at": PLACE, "and": PLACE, "value": true} two places are of one object, or of two (false)
    {"what": "box", "at": PLACE, "box": {"x": 3.1, "y": 4.0, "z": 1.0, "yaw": 0.1, "length": 4.2, "width": 1.8,
     "height": 1.5, "time": 11.0}, "deviation": {"position": 0.1, "height": 0.1, "yaw": 0.05, "size": 0.05},
     "label": "car"}
    {"what": "standing", "at": PLACE, "until": 12.5}           from the time of the place to another
    {"what": "size", "at": PLACE, "box": {"length": 4.2, "width": 1.8, "height": 1.5}}

PLACE is {"time": 10.2, "x": 3.5, "y": 4.1, "label": "car"}: s, m in the world, and the class if known. Of a box x and
y alone are required; its time is that of the place unless it has one. Every line may have who, when and scene.
`saga_fg.smoothing.corrections` says what they do.

Labels that came back from a labelling tool are compared with those that went out: what differs is corrections. A box
that came back is one that went out where it is the same to `SAME`; else the box of its object at its moment; else the
nearest within `REACH`. The object of a track that came back is that of its unchanged boxes, those nearest in time
first, so that tools may number tracks anew. Then

    two tracks in one object, two objects in one track   same: false, same: true
    no box of an object left                             exists: false
    boxes gone at its begin or end                       same: false, and exists: false of the part
    another class                                        class
    another size                                         size, of the whole object
    moved or turned                                      box
    a box of no object                                   box, with class and size; of a new track about one object

Moments that did not come back are left as they are. Boxes that are gone where nothing was detected, or amid an object,
can't be said by corrections: they are named.
"""

import csv
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.detection_files import write_rows
from data_tools.datasets.results import SceneResult
from data_tools.files import parsed_json, read_lines, read_text, write_text
from data_tools.metrics import SceneBoxes, near_pairs
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import BoolArray, IntArray, wrap_angle
from saga_fg.smoothing.corrections import Correction, correction_from
from saga_fg.types import Boxes

COLUMNS = ("scene", "correction", "what", "timestamp", "x", "y", "who", "when", "problem")


def read_corrections(path: Path) -> tuple[Correction, ...]:
    """Read a file, which may have none. Raises `InputError` naming line and field of one that can't be used."""
    return corrections_of_lines(read_lines(path), path)


def corrections_of_lines(lines: Iterable[str], path: Path) -> tuple[Correction, ...]:
    """The corrections of a file's lines; raises as `read_corrections` does."""
    numbered = [(f"{path}: line {number}", line) for number, line in enumerate(lines, 1) if line.strip()]
    return tuple(correction_from(parsed_json(line, origin), origin) for origin, line in numbered)


def correction_lines(path: Path) -> list[str]:
    """The lines of a file, none where it is not there."""
    return read_text(path).splitlines() if path.exists() else []


def write_correction_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a file whole."""
    write_text(path, "".join(f"{line}\n" for line in lines))


def check_classes(corrections: Iterable[Correction], classes: tuple[str, ...]) -> None:
    """Raise `InputError` for a correction to a class that labels can't have; classes: () for any."""
    for one in corrections:
        if classes and one.label and one.label not in classes:
            raise InputError(f"{one.origin}: label: {unknown_name('class', one.label, classes)}")


Outcomes = Sequence[tuple[str, Correction, str]]
"""Scene, a correction that may be about it, and why it does not hold there; "" where it does."""


def write_outcomes(path: Path, outcomes: Outcomes) -> None:
    """Write what became of corrections, as a table."""
    write_rows(
        path,
        COLUMNS,
        ([scene, c.origin, c.what, c.at.time, c.at.x, c.at.y, c.who, c.when, why] for scene, c, why in outcomes),
    )


def read_outcomes(folder: Path) -> list[tuple[str, str]]:
    """Name and problem of the corrections in the tables of a folder."""
    found = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            found += [(row["correction"], row["problem"]) for row in csv.DictReader(file)]
    return found


SAME = 0.02  # m and rad; Datumaro writes two decimals
REACH = 2.0  # between the centres of a box before and after, m
SIZE = ("length", "width", "height")

Record = dict[str, Any]


class Edits:
    """Labels that tools can hold (`labelling_tools.exchanged`), and `theirs`, which came back with the frames `back`.

    problems: after `corrections`, a line for each change that none can say
    """

    def __init__(self, result: SceneResult, theirs: SceneBoxes, back: IntArray) -> None:
        self.scene, self.ours, self.theirs = result.scene, result.found, theirs
        step = float(np.median(np.diff(result.scene.timestamps))) if len(result.scene) > 1 else 0.0
        self.seen = np.nan_to_num(0.0 if result.coasting is None else result.coasting) <= step / 2
        self.seen = np.broadcast_to(self.seen, len(self.ours))
        self.pair = _pairs(self.ours, theirs)
        self.gone = np.isin(self.ours.frame, back)
        self.gone[self.pair[self.pair >= 0]] = False
        missing = np.setdiff1d(np.unique(self.ours.frame), back)
        self.problems: list[str] = []
        if len(missing):
            frames = f"{len(missing)} frames, the first {missing[0]}, did not come back"
            self.problems.append(f"{frames}: their labels stay as they are")

    def corrections(self) -> list[Record]:
        """Return the corrections, as lines of a file, that turn labels into those that came back."""
        rows = np.flatnonzero(self.pair >= 0)
        part = np.full(len(self.theirs), -1, dtype=np.int64)
        found: list[Record] = []
        for number, mine in enumerate(_grouped(self.ours.id[self.pair[rows]], rows).values()):
            part[mine] = number * len(part)
            for before, row in pairwise(mine):
                cut = self.theirs.id[before] != self.theirs.id[row]
                part[row] = part[before] + cut
                if cut:
                    found.append(self._same(self.pair[before], self.pair[row], value=False))
        parts = _grouped(part[rows], rows)
        joined = set()
        for mine in _grouped(self.theirs.id[rows], rows).values():
            for a, b in pairwise(part[mine].tolist()):
                if a != b and frozenset((a, b)) not in joined:
                    joined.add(frozenset((a, b)))
                    found.append(self._same(*(self.pair[_middle(parts[one])] for one in (a, b)), value=True))
        found += self._deletions()
        for mine in parts.values():
            found += self._changes(self.pair[mine], np.array(mine))
        return [*found, *self._additions()]

    def _deletions(self) -> Iterator[Record]:
        """Objects that are gone, and ends of others."""
        for id_, mine in _grouped(self.ours.id, np.arange(len(self.ours))).items():
            gone, seen = self.gone[mine], self.seen[mine]
            if gone.all():
                yield self._about("exists", _middle(mine), value=False)
                continue
            kept = np.flatnonzero(~gone)
            ends = [np.arange(kept[0])[::-1], np.arange(kept[-1] + 1, len(mine))]  # outwards
            for end, last in zip(ends, (kept[0], kept[-1]), strict=True):
                detected = end[seen[end]]
                if len(detected) and seen[kept].any():
                    yield self._same(mine[last], mine[detected[0]], value=False)
                    yield self._about("exists", mine[detected[-1]], value=False)
                elif len(end):
                    self.problems.append(f"object {id_}: {len(end)} boxes gone where nothing is detected: they stay")
            if amid := int(gone[kept[0] : kept[-1]].sum()):
                self.problems.append(f"object {id_}: {amid} boxes gone amid it: they stay; a cut in two would part it")

    def _changes(self, before: IntArray, after: IntArray) -> Iterator[Record]:
        """Changes of a part of an object, of boxes by their rows before and after."""
        ours, theirs = self.ours.boxes, self.theirs.boxes
        was, labels = str(ours.label[before[0]]), Counter(theirs.label[after].tolist())
        ((label, most),) = labels.most_common(1)
        if label != was:
            yield self._about("class", _middle(before.tolist()), label=label)
        if others := labels.total() - most - (label != was) * labels[was]:
            id_ = self.ours.id[before[0]]
            self.problems.append(f"object {id_}: {others} boxes of another class: an object has one, here {label}")
        moved, turned, resized = _changed(ours.select(before), theirs.select(after))
        if resized.any():
            ((size, _),) = Counter(tuple(s) for s in theirs.size[after[resized]].round(2).tolist()).most_common(1)
            yield self._about("size", int(before[np.argmax(resized)]), box=dict(zip(SIZE, size, strict=True)))
        for k in np.flatnonzero(moved.any(axis=1) | turned).tolist():
            box = _place_of(theirs, int(after[k]), height=bool(moved[k, 2]), yaw=bool(turned[k]))
            yield self._about("box", int(before[k]), box=box)

    def _additions(self) -> Iterator[Record]:
        """Boxes of no object; those of a track that has an object are its."""
        boxes = self.theirs.boxes
        for mine in _grouped(self.theirs.id, np.arange(len(self.theirs))).values():
            known = [row for row in mine if self.pair[row] >= 0]
            new = [row for row in mine if self.pair[row] < 0]
            for row in new:
                near = min(known or new[:1], key=lambda other: abs(self.theirs.frame[other] - self.theirs.frame[row]))
                time = float(self.scene.timestamps[self.theirs.frame[row]])
                size = dict(zip(SIZE, boxes.size[row].round(3).tolist(), strict=True))
                box = {"time": time, **_place_of(boxes, row, height=True, yaw=True), **size}
                about = self._place(self.ours, int(self.pair[near])) if known else self._place(self.theirs, near)
                yield {"what": "box", "at": about, "label": str(boxes.label[row]), "box": box, "scene": self.scene.name}

    def _same(self, a: int, b: int, *, value: bool) -> Record:
        return self._about("same", a, **{"and": self._place(self.ours, b)}, value=value)

    def _about(self, what: str, row: int, **fields: Any) -> Record:
        return {"what": what, "at": self._place(self.ours, row), **fields, "scene": self.scene.name}

    def _place(self, found: SceneBoxes, row: int) -> Record:
        x, y = found.boxes.position[row, :2].round(3).tolist()
        time = float(self.scene.timestamps[found.frame[row]])
        return {"time": time, "x": x, "y": y, "label": str(found.boxes.label[row])}


def _pairs(ours: SceneBoxes, theirs: SceneBoxes) -> IntArray:
    """(N,) the row of ours that each of theirs is, unchanged or edited; -1 for none."""
    pair = np.full(len(theirs), -1, dtype=np.int64)
    near = _near(ours, theirs, 2 * SAME)
    changed = _changed(ours.boxes.select(near[:, 0]), theirs.boxes.select(near[:, 1]))
    equal = np.asarray(~np.column_stack(changed).any(axis=1))
    renamed = ours.id[near[:, 0]] != theirs.id[near[:, 1]]
    recoloured = ours.boxes.label[near[:, 0]] != theirs.boxes.label[near[:, 1]]
    order = np.lexsort((recoloured, renamed))
    _take(pair, near[order[equal[order]]])
    settled = np.flatnonzero(pair >= 0)
    kept = not len(settled) or (ours.id[pair[settled]] == theirs.id[settled]).mean() >= 0.5
    unchanged = {id_: np.array(mine) for id_, mine in _grouped(theirs.id[settled], settled).items()}
    place = {(k, id_): row for row, (k, id_) in enumerate(zip(ours.frame.tolist(), ours.id.tolist(), strict=True))}
    named: list[tuple[int, int]] = []
    for row in np.flatnonzero(pair < 0).tolist():
        k, id_ = int(theirs.frame[row]), str(theirs.id[row])
        mine = unchanged.get(id_, settled[:0])
        mine = mine[np.argsort(np.abs(theirs.frame[mine] - k), kind="stable")]
        names = dict.fromkeys([*ours.id[pair[mine]].tolist(), *([id_] if kept else [])])
        named += [(place[k, name], row) for name in names if (k, name) in place]
    _take(pair, named)
    _take(pair, _near(ours, theirs, REACH))
    return pair


def _near(ours: SceneBoxes, theirs: SceneBoxes, reach: float) -> IntArray:
    """(P, 2) rows of boxes of one frame within a reach, m, the nearest first."""
    placed = [(each.frame, replace(each.boxes, label=np.full(len(each), "any"))) for each in (ours, theirs)]
    row, column, distance = near_pairs(placed[0], placed[1], reach)
    return np.column_stack([row, column])[np.argsort(distance, kind="stable")]


def _take(pair: IntArray, candidates: Iterable[Any]) -> None:
    """Pair rows that have no partner yet, the first candidates first."""
    taken = set(pair[pair >= 0].tolist())
    for a, b in np.asarray(candidates, dtype=np.int64).reshape(-1, 2).tolist():
        if pair[b] < 0 and a not in taken:
            pair[b] = a
            taken.add(a)


def _changed(before: Boxes, after: Boxes) -> tuple[BoolArray, BoolArray, BoolArray]:
    """(N, 3) where centres are others, (N,) headings, (N,) sizes."""
    moved = np.abs(after.position - before.position) > SAME
    turned = np.abs(wrap_angle(after.yaw - before.yaw)) > SAME
    return moved, turned, np.asarray((np.abs(after.size - before.size) > SAME).any(axis=1))


def _place_of(boxes: Boxes, row: int, height: bool, yaw: bool) -> dict[str, float]:
    """Where a box is, as a correction says it."""
    x, y, z = boxes.position[row].round(3).tolist()
    turned = {"yaw": round(float(boxes.yaw[row]), 4)} if yaw else {}
    return {"x": x, "y": y, **({"z": z} if height else {}), **turned}


def _grouped(names: Any, rows: IntArray) -> dict[Any, list[int]]:
    """Rows by the names of what they are of, in order of time."""
    found: dict[Any, list[int]] = defaultdict(list)
    for name, row in zip(names.tolist(), rows.tolist(), strict=True):
        found[name].append(row)
    return found


def _middle(rows: list[int]) -> int:
    return rows[len(rows) // 2]
