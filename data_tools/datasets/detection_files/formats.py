"""The formats of tables of boxes: CSV, newline-delimited JSON, NumPy archives, Parquet and Feather."""

import codecs
import csv
import logging
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TextIO, TypeVar

import numpy as np

from data_tools.files import SUFFIXES, arrow_columns, arrow_names, load_archive, open_bytes, open_text, parsed_json
from saga_fg.errors import InputError
from saga_fg.tables import (
    COLUMNS,
    COMMAND,
    NAMED,
    REQUIRED,
    Clock,
    Columns,
    RawTable,
    TableImport,
    Values,
    as_names,
    canonical,
    clock_of,
    meaning,
    option_text,
    sorted_by_time,
    understood,
)
from saga_fg.types import LATEST

log = logging.getLogger(__name__)

Row = TypeVar("Row")
ROWS = 50_000  # of a part of a table
_VEHICLE = tuple(name for name in COLUMNS if name.startswith(("ego_", "odometry_", "gps_")))
OF_FRAMES = frozenset(("scene", "timestamp", "sensor", "coordinates", *_VEHICLE))
DEEPEST = 8  # levels of a JSON object that are taken apart
STAMPS = (("nanosec", "sec"), ("nsec", "sec"), ("nsecs", "secs"), ("nanos", "seconds"))  # parts of a time
TRACK_MEANINGS = ("id",)  # of tracks, which need no word where detections are read
_OPEN_QUOTE = "a quote is opened and not closed on this line"


@dataclass(frozen=True)
class Layout:
    """The columns a table may have, and those it must.

    lenient  a column that --columns names need not be there
    faulty   columns that are missing or misspelt are no error
    within   how its options are named, as of `option_text`
    """

    columns: tuple[str, ...] = COLUMNS
    required: tuple[str, ...] = REQUIRED
    lenient: bool = False
    faulty: bool = False
    within: str = COMMAND


@dataclass(frozen=True)
class _Reading:
    """A file to be read: of which columns, how, in parts of so many rows."""

    path: Path
    layout: Layout
    how: TableImport
    rows: int
    own: Collection[str] | None

    def hint(self, names: Collection[str]) -> TableImport:
        """Hint in an error message: how to read a file with these columns."""
        return TableImport(as_given=True) if self.own is not None and set(self.own) <= set(names) else self.how

    def understood(self, names: Collection[str]) -> Columns:
        """The columns of the file by their meaning. Raises `InputError` for all that is wrong with their names."""
        layout = self.layout
        found = understood(names, layout.columns, layout.required, self.hint(names), layout.lenient, layout.within)
        if found.faults and not (layout.faulty and names):
            raise InputError(f"{self.path}: {'; '.join(found.faults)}")
        return found


def read_raw_table(
    path: Path, layout: Layout | None = None, how: TableImport | None = None, own: Collection[str] | None = None
) -> RawTable:
    """Read a table, of detections unless another layout is given, by its suffix.

    own  columns by which a table is known as one of ours, on which `how` has no effect

    Raises `InputError` for another suffix and for files that are not what it says.
    """
    (table,) = read_raw_parts(path, layout, how, sys.maxsize, own)
    return table


def read_raw_parts(
    path: Path,
    layout: Layout | None = None,
    how: TableImport | None = None,
    rows: int = ROWS,
    own: Collection[str] | None = None,
    quiet: bool = False,
) -> Iterator[RawTable]:
    """Read a table in parts of about `rows` rows, in their order; rows of one scene and time stay together.

    A file without rows is one empty part; a table that is no text, or is to be sorted, is one part. Columns
    that nobody gives in a part are missing from it. Unless `quiet`, warns of columns that are not read, and of a clock
    that is guessed.
    """
    how = how or TableImport()
    clock: Clock | None = None
    told: set[str] = set()
    reading = _Reading(path, layout or Layout(), how, sys.maxsize if how.sort else rows, own)
    for table in _tables(reading):
        table = replace(table, within=reading.layout.within)
        if clock is None and table.length:
            clock = clock_of(table)
            if not quiet:
                _tell(table, clock)
        unread = set(table.found.unread) - told - set(TRACK_MEANINGS)
        if unread and not quiet:
            names = [name[:40] for name in sorted(unread)]
            more = f", ... ({len(names)} in all)" if len(names) > 12 else ""
            reads = option_text({"columns": {"OURS": "THEIRS"}}, table.within)
            shown = ", ".join(names[:12]) + more
            log.warning("%s: columns without a meaning here, not read: %s; %s reads one", path, shown, reads)
        told |= unread
        table = replace(table, clock=clock or Clock())
        yield sorted_by_time(table) if how.sort else table


def _tables(reading: _Reading) -> Iterator[RawTable]:
    """The parts of a file as they are read."""
    readers: dict[str, Callable[[_Reading], Iterator[RawTable]]] = {
        ".csv": _read_csv,
        ".ndjson": _read_ndjson,
        ".jsonl": _read_ndjson,
        **dict.fromkeys((".npz", *SUFFIXES), _read_columns),
    }
    path = reading.path
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a file name that ends in {', '.join(readers)}{_of_a_dataset(path)}")
    try:
        yield from readers[path.suffix.lower()](reading)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8{_foreign_line(path)}") from error


_OF_DATASETS = (
    (re.compile(r"\d+[ ,]-?\d+[ ,][A-Z][a-z_]+[ ,]"), "KITTI", "kitti"),
    (re.compile(r"\d+(,-?[0-9.e+-]+){5,}$"), "MOTChallenge", "motchallenge"),
    (re.compile(r"\{.*\"(results|meta)\""), "nuScenes", "nuscenes"),
)
"""Datasets by the first line of their files: a pattern, the name, and the command that reads them."""


def _of_a_dataset(path: Path) -> str:
    """Error message for a file in the format of a dataset: the command that reads it; "" for others."""
    try:
        with open_bytes(path) as file:
            line = file.readline(1000).decode(errors="replace").strip()
    except (OSError, InputError):
        return ""
    for begins, name, command in _OF_DATASETS:
        if begins.match(line):
            return f"; its first line looks like one of {name}, which `saga-fg track {command} --help` reads"
    return ""


def _foreign_line(path: Path) -> str:
    """Error message for a file that is not UTF-8: the place in it, and the remedy."""
    with open_bytes(path) as file:
        for number, line in enumerate(file, start=1):
            try:
                line.decode()
            except UnicodeDecodeError:
                wide = line.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
                looks, code = ("UTF-16", "utf-16") if wide else ("another encoding, such as Latin-1", "latin1")
                convert = f"iconv -f {code} -t utf-8 {shlex.quote(str(path))}"
                return f", line {number} is in {looks}; convert the file: {convert}"
    return ""


def _tell(table: RawTable, clock: Clock) -> None:
    for ours, theirs in table.found.names.items():
        if ours != theirs or ours in table.found.units:
            log.info("%s: %s is read from %r, in %s", table.path, ours, theirs, table.found.units.get(ours, "our unit"))
    length, width = (table.found.names.get(name, "") for name in ("length", "width"))
    if length.endswith("_x") and width.endswith("_y"):
        order, other = "is read as length, width, height", {"columns": {"length": width, "width": length}}
        swapped, size = option_text(other, table.within), length.removesuffix("_x")
        log.warning("%s: %s %s; where width comes first: %s", table.path, size, order, swapped)
    if clock.guessed:
        long = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}[clock.unit]
        says = option_text({"units": {"time": clock.unit}}, table.within)
        log.warning("%s: times are read as %s, by their size; %s says so", table.path, long, says)


def _read_csv(reading: _Reading) -> Iterator[RawTable]:
    path = reading.path
    with open_text(path, encoding="utf-8-sig", newline="") as file:
        numbered = _csv_rows(path, file)
        header = [name.strip() for name in next(numbered, (1, []))[1]]
        if len(set(header)) != len(header):
            got = ", ".join(name[:40] for name in header)
            raise InputError(f"{path}: line 1: expected every column once, got {got}")
        found = reading.understood(header)
        at = {ours: header.index(theirs) for ours, theirs in found.names.items()}
        moment = [at[name] for name in ("scene", "timestamp") if name in at]
        for lines, rows in _parts(
            _full_rows(path, numbered, len(header)), reading.rows, lambda row: [row[i].strip() for i in moment]
        ):
            columns: dict[str, Values] = {name: [row[i].strip() or None for row in rows] for name, i in at.items()}
            yield RawTable(path, columns, len(rows), partial(_line, lines), True, found, reading.hint(header))


def _csv_rows(path: Path, file: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and values, which commas, semicolons or tabs separate.

    A value in quotes ends on its line, so that a stray quote swallows no others.
    """
    header = file.readline()
    file.seek(0)
    separator = next((each for each in ",;\t" if each in header), ",")
    reader = csv.reader(file, delimiter=separator, strict=True)
    while True:
        number = reader.line_num + 1
        try:
            row = next(reader, None)
        except csv.Error as error:
            reason = _OPEN_QUOTE if reader.line_num > number else str(error)
            raise InputError(f"{path}: line {number}: expected comma-separated values: {reason}") from error
        if row is None:
            return
        if reader.line_num > number:
            raise InputError(f"{path}: line {number}: expected comma-separated values: {_OPEN_QUOTE}")
        yield number, row


def _full_rows(path: Path, numbered: Iterator[tuple[int, list[str]]], columns: int) -> Iterator[tuple[int, list[str]]]:
    for number, row in numbered:
        if not row:
            continue
        if len(row) != columns:
            raise InputError(f"{path}: line {number}: expected {columns} columns, got {len(row)}")
        yield number, row


def _read_ndjson(reading: _Reading) -> Iterator[RawTable]:
    path, layout = reading.path, reading.layout
    with open_text(path, encoding="utf-8-sig", newline="") as file:
        for lines, rows in _parts(_json_rows(path, file), reading.rows, _moment(reading.how)):
            names = set().union(*rows)
            if not rows:
                names = set(layout.columns)
            if all(isinstance(row, EmptyFrame) for row in rows) or {canonical(name) for name in names} <= OF_FRAMES:
                names |= {"x", "y"}
            found = reading.understood(names)
            columns: dict[str, Values] = {
                ours: [row.get(theirs) for row in rows] for ours, theirs in found.names.items()
            }
            yield RawTable(path, columns, len(rows), partial(_line, lines), False, found, reading.hint(names))


Nested = dict[tuple[str, ...], Any]
"""Values of a JSON object by the names on the way to each."""


class EmptyFrame(dict[str, Any]):
    """A row of a frame without objects: the values of the frame itself."""


def _json_rows(path: Path, file: TextIO) -> Iterator[tuple[int, dict[str, Any]]]:
    """Line numbers and rows. Lines whose lists are all empty wait for one that tells which list has the objects."""
    names = set[str]()  # of lists of objects
    waiting: list[tuple[int, Nested, dict[str, list[dict[str, Any]]]]] = []
    for number, line in enumerate(file, start=1):
        if not line.strip():
            continue
        row = parsed_json(line, f"{path}: line {number}")
        if not isinstance(row, dict):
            raise InputError(f"{path}: line {number}: expected an object, got {line.strip()[:40]!r}")
        if not any(isinstance(value, dict | list) for value in row.values()):
            yield number, row
            continue
        common, lists = _flattened((), row)
        filled = {name: entries for name, entries in lists.items() if entries}
        if len(filled) > 1:
            raise InputError(f"{path}: line {number}: expected one list of objects, got {', '.join(sorted(filled))}")
        names |= filled.keys()
        waiting.append((number, common, lists))
        if not names and lists:
            continue
        yield from ((before, _without_objects(each, names, of)) for before, each, of in waiting[:-1])
        waiting.clear()
        if not filled:
            yield number, _without_objects(common, names, lists)
        shared = _named(common, of_frame=True)
        for entry in next(iter(filled.values()), []):
            own, deeper = _flattened((), entry)
            if any(deeper.values()):
                raise InputError(f"{path}: line {number}: {min(deeper)}: expected no list of objects in an object")
            yield number, {**shared, **_named(own)}
    found = {(meaning(name) or (name,))[0] for _, common, _ in waiting for name in _named(common)}
    for number, common, lists in waiting:
        yield number, _without_objects(common, () if {"x", "y"} <= found else lists, lists)


def _without_objects(common: Nested, names: Collection[str], lists: Collection[str]) -> dict[str, Any]:
    """The row of a line without objects; of a frame where one of its `lists` has the name of one of objects."""
    if set(names).isdisjoint(lists):
        return _named(common)
    return EmptyFrame(_named(common, of_frame=True))


def _flattened(within: tuple[str, ...], values: Mapping[str, Any]) -> tuple[Nested, dict[str, list[dict[str, Any]]]]:
    """The values of a JSON object, and its lists of objects.

    A list of up to three has x, y and z; seconds and nanoseconds are one time, s.
    """
    plain: Nested = {}
    lists: dict[str, list[dict[str, Any]]] = {}
    for key, value in values.items():
        path = (*within, key)
        if isinstance(value, list) and all(isinstance(each, dict) for each in value) and (value or not meaning(key)):
            lists[key] = value
            continue
        if value and isinstance(value, list) and len(value) <= 3:
            value = dict(zip("xyz", value, strict=False))
        if isinstance(value, dict) and tuple(sorted(value)) in STAMPS:
            plain[path] = _seconds(value)
        elif value and isinstance(value, dict) and len(path) < DEEPEST:
            deeper = _flattened(path, value)
            plain |= deeper[0]
            lists |= deeper[1]
        else:
            plain[path] = value
    return plain, lists


def _named(values: Nested, of_frame: bool = False) -> dict[str, Any]:
    """Values by their names in a table; of two of one name the last."""
    return {_joined(path, of_frame): value for path, value in values.items()}


def _seconds(stamp: dict[str, Any]) -> Any:
    """Time in s of whole seconds and nanoseconds; what is none stays as it is."""
    nanoseconds, seconds = (stamp[part] for part in sorted(stamp))
    whole = all(isinstance(part, int) and abs(part) <= LATEST for part in (nanoseconds, seconds))
    return seconds + 1e-9 * nanoseconds if whole else stamp


@lru_cache(1024)
def _joined(path: tuple[str, ...], of_frame: bool) -> str:
    """Name of a nested value, as short as it takes to have a meaning: box.position.x is position_x, box.length length.

    What is said of the vehicle (ego) keeps its whole name, and x its owner's. Nested values of a frame with a list are
    none of its objects: the speed of `vehicle` is not theirs.
    """
    shortest = len(path) - (1 if len(path[-1]) > 1 else 2)
    names = ["_".join(path[start:]) for start in range(1 if path[0].startswith("ego") else shortest + 1)]
    if not of_frame or len(path) == 1:
        return next((name for name in names if meaning(name) is not None), "_".join(path))
    known = (name for name in names if (found := meaning(name)) is not None and found[0] in OF_FRAMES)
    return next(known, "_".join(("frame", *path)))


def _parts(
    numbered: Iterator[tuple[int, Row]], most: int, moment: Callable[[Row], list[Any]]
) -> Iterator[tuple[list[int], list[Row]]]:
    """Line numbers and rows, parted where the moment changes and there are enough; at least one part."""
    lines: list[int] = []
    rows: list[Row] = []
    for number, row in numbered:
        if len(rows) >= most and moment(row) != moment(rows[-1]):
            yield lines, rows
            lines, rows = [], []
        lines.append(number)
        rows.append(row)
    yield lines, rows


def _line(lines: list[int], row: int) -> str:
    return f"line {lines[row]}"


def _read_columns(reading: _Reading) -> Iterator[RawTable]:
    """The one part of a file that is no text."""
    path = reading.path
    archive = path.suffix.lower() == ".npz"
    names = load_archive(path, ())[0] if archive else arrow_names(path)
    found = reading.understood(names)
    wanted = list(found.names.values())
    theirs = load_archive(path, wanted)[1] if archive else arrow_columns(path, wanted)
    columns: dict[str, Values] = {ours: theirs[name] for ours, name in found.names.items()}
    first = "timestamp" if "timestamp" in columns else next(iter(columns))
    length = 0 if archive and np.ndim(columns[first]) != 1 else len(columns[first])
    for ours, column in columns.items():
        if archive and np.shape(column) != (length,):
            raise InputError(f"{path}: {ours}: expected shape ({length},) as {first} has, got {np.shape(column)}")
        if ours in NAMED and not archive:
            columns[ours] = as_names(column)
    yield RawTable(path, columns, length, "row {}".format, False, found, reading.hint(names))


def _moment(how: TableImport) -> Callable[[dict[str, Any]], list[Any]]:
    """Return what gives the scene and the time of a row, by any names of theirs."""
    given = [how.columns[name] for name in ("scene", "timestamp") if name in how.columns]
    known: dict[str, bool] = dict.fromkeys(given, True)

    def moment(row: dict[str, Any]) -> list[Any]:
        for name in row:
            if name not in known:
                known[name] = (meaning(name) or ("",))[0] in ("scene", "timestamp")
        return [value for name, value in row.items() if known[name]]

    return moment
