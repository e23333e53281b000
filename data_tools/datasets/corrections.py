"""Files of corrections, JSON lines of which each is one, and what became of them.

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
"""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from data_tools.datasets.detection_files import write_rows
from data_tools.files import check_writable, parsed_json, read_lines, read_text, write_text
from saga_fg.errors import InputError, unknown_name
from saga_fg.smoothing.corrections import Correction, correction_from

COLUMNS = ("scene", "correction", "what", "timestamp", "x", "y", "who", "when", "problem")


def read_corrections(path: Path) -> tuple[Correction, ...]:
    """Read a file. Raises `InputError` naming line and field of one that can't be used."""
    found = corrections_of_lines(read_lines(path), path)
    if not found:
        raise InputError(f"{path}: expected corrections, a line each, there are none")
    return found


def corrections_of_lines(lines: Iterable[str], path: Path) -> tuple[Correction, ...]:
    """The corrections of a file's lines; raises as `read_corrections` does, but not where there are none."""
    found = []
    for number, line in enumerate(lines, 1):
        if line.strip():
            origin = f"{path}: line {number}"
            found.append(correction_from(parsed_json(line, origin), origin))
    return tuple(found)


def correction_lines(path: Path) -> list[str]:
    """The lines of a file, none where it is not there."""
    return read_text(path).splitlines() if path.exists() else []


def write_correction_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a file whole; one without corrections goes, as readers take none."""
    if any(line.strip() for line in lines):
        write_text(path, "".join(f"{line}\n" for line in lines))
    else:
        check_writable(path)
        path.unlink(missing_ok=True)


def check_classes(corrections: Iterable[Correction], classes: tuple[str, ...]) -> None:
    """Raise `InputError` for a correction to a class that labels can't have; classes: () for any."""
    for one in corrections:
        if classes and one.label and one.label not in classes:
            raise InputError(f"{one.origin}: label: {unknown_name('class', one.label, classes)}")


Outcomes = Sequence[tuple[str, Correction, str]]
"""Scene, a correction that may be about it, and why it does not hold there; "" where it does."""


def write_outcomes(path: Path, outcomes: Outcomes) -> None:
    """Write what became of corrections, as a table."""
    rows = (
        [scene, one.origin, one.what, one.at.time, one.at.x, one.at.y, one.who, one.when, why]
        for scene, one, why in outcomes
    )
    write_rows(path, COLUMNS, rows)


def read_outcomes(folder: Path) -> list[tuple[str, str]]:
    """Name and problem of the corrections in the tables of a folder."""
    found = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="", encoding="utf-8") as file:
            found += [(row["correction"], row["problem"]) for row in csv.DictReader(file)]
    return found
