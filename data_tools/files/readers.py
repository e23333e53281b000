"""Readers of plain files: lines of numbers, large JSON, NumPy archives, Parquet and Feather.

Reading large JSON files one value at a time.

`json.load` of the tables of a full nuScenes download needs several gigabytes; here only the current entry of the
outermost array or object is in memory. Entries are decoded by the C scanner of the standard library, which accepts the
words NaN and Infinity in result files (ijson, equally fast, refuses them).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from data_tools.files.file_access import open_bytes, open_text, read_text
from data_tools.files.isolated_reading import isolated
from saga_fg.errors import InputError, error_context, require_extra
from saga_fg.numerics import BoolArray, FloatArray, refuse

LONGEST = 100  # characters of a value
LARGEST = 1e15  # largest number; its square does not overflow
_EXACT = 2.0**53  # floats below it tell whole numbers apart


@dataclass(frozen=True, eq=False)
class TextTable:
    """Rows of equally many values as text (N, C), and the line number (N,) of each."""

    path: Path
    values: np.ndarray[tuple[int, int], np.dtype[np.str_]]
    line: np.ndarray[tuple[int], np.dtype[np.int64]]

    @classmethod
    def from_rows(cls, path: Path, rows: list[list[str]], line: list[int], columns: int = 0) -> TextTable:
        """A table of rows; `columns` is how many there are where there is no row. Raises `InputError` for long values.

        NumPy stores all texts of an array with the width of the longest.
        """
        for number, row in zip(line, rows, strict=True):
            longest = max(row, key=len, default="")
            if len(longest) > LONGEST:
                got = f"{longest[:20]!r}..., {len(longest)} characters"
                raise InputError(f"{path}: line {number}: expected values of at most {LONGEST} characters, got {got}")
        values = np.array(rows, dtype=np.str_) if rows else np.empty((0, columns), dtype=np.str_)
        return cls(path, values, np.array(line, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.values)

    def numbers(
        self, columns: list[int] | slice, names: tuple[str, ...], largest: float | tuple[float, ...] = LARGEST
    ) -> FloatArray:
        """Some columns as floats (N, C) of at most this size. Raises `InputError` naming line and column."""
        text = self.values[:, columns]
        try:
            numbers = text.astype(np.float64)
        except ValueError:
            numbers = np.array([[_number(x) for x in row] for row in text]).reshape(text.shape)
        bad = ~np.isfinite(numbers)
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            raise self.fault(row, f"{names[column]}: expected a finite number, got {str(text[row, column])[:40]!r}")
        large = np.abs(numbers) > largest
        if large.any():
            row, column = (int(i) for i in np.argwhere(large)[0])
            most = np.broadcast_to(largest, large.shape)[row, column]
            raise self.fault(row, f"{names[column]}: expected a number within {most:g}, got {numbers[row, column]:g}")
        return np.asarray(numbers, dtype=np.float64)

    def integers(
        self, column: int, name: str, smallest: int, largest: int = 2**31
    ) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """A column as whole numbers (N,). Raises `InputError` naming the line of one out of range."""
        text = self.values[:, column]
        try:
            numbers = text.astype(np.int64)  # exact, where floats are not from 2^53 on
            bad = (numbers < smallest) | (numbers > largest)
        except (ValueError, OverflowError):
            self.numbers([column], (name,), np.inf)
            whole = [_whole(value) for value in text.tolist()]
            bad = np.array([value is None or not smallest <= value <= largest for value in whole])
            numbers = np.array([0 if wrong else value for value, wrong in zip(whole, bad, strict=True)], dtype=np.int64)
        expected = f"{name}: expected a whole number from {smallest} to {largest}"
        refuse(bad, lambda row: self.fault(row, f"{expected}, got {text[row][:40]}"))
        return numbers

    def check(self, good: BoolArray, what: Callable[[int], str]) -> None:
        """Raise `InputError` about the first row that is not good (N,); what: says what is wrong with a row."""
        refuse(~good, lambda row: self.fault(row, what(row)))

    def fault(self, row: int, what: str) -> InputError:
        """An error about one row."""
        return InputError(f"{self.path}: line {self.line[row]}: {what}")


def read_lines(path: Path) -> list[str]:
    """The lines of a text file. Raises `InputError` if it cannot be read."""
    return read_text(path).splitlines()


def read_table(
    path: Path, columns: tuple[int, ...], what: str, separator: str | None = None, comment: str | None = None
) -> TextTable:
    """Read lines of values; all must have the same number of values, one of `columns`.

    Empty lines are left out, as are those that start with `comment`.
    Raises `InputError` naming the first line that has another number.
    """
    rows: list[list[str]] = []
    numbers: list[int] = []
    for number, line in enumerate(read_lines(path), start=1):
        row = line.split(separator)
        if not row or row == [""] or (comment is not None and line.lstrip().startswith(comment)):
            continue
        if len(row) not in columns or (rows and len(row) != len(rows[0])):
            expected = len(rows[0]) if rows else " or ".join(map(str, columns))
            raise InputError(f"{path}: line {number}: expected {expected} columns ({what}), got {len(row)}")
        rows.append(row)
        numbers.append(number)
    return TextTable.from_rows(path, rows, numbers, columns[0])


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _whole(text: str) -> int | None:
    """The whole number that a text says exactly, if it does: 12, 12.0 and 1.2e1, but not 7e18."""
    try:
        return int(text)
    except ValueError:
        number = float(text)
        return int(number) if number.is_integer() and abs(number) < _EXACT else None


_SPACE = " \t\n\r"
_DIGITS = 19  # longer integers are read as floats, which may be infinite
_decoder = json.JSONDecoder(parse_int=lambda text: int(text) if len(text.lstrip("-")) <= _DIGITS else float(text))


class JsonStream:
    """A position in a JSON text that is read piece by piece. Every error is an `InputError` with file and position."""

    def __init__(self, file: TextIO, name: str, piece: int = 1 << 20) -> None:
        self._file, self._name, self._piece = file, name, piece
        self._text, self._at, self._before, self._ended = "", 0, 0, False

    def peek(self) -> str:
        """The next character that is no white space; "" at the end of the text."""
        while True:
            while self._at < len(self._text) and self._text[self._at] in _SPACE:
                self._at += 1
            if self._at < len(self._text) or not self._more():
                return self._text[self._at : self._at + 1]

    def take(self, expected: str) -> None:
        """Step over one character."""
        if self.peek() != expected:
            raise self._fault(f"expected {expected!r}")
        self._at += 1

    def value(self) -> Any:
        """Decode the value that starts here and step over it."""
        self.peek()
        while True:
            try:
                value, end = _decoder.raw_decode(self._text, self._at)
            except RecursionError as error:
                raise self._fault("nested too deeply") from error
            except ValueError as error:  # incomplete so far, or broken
                if self._more():
                    continue
                raise self._fault(f"broken or truncated JSON ({getattr(error, 'msg', error)})") from error
            if isinstance(value, int | float) and len(self._text) - end < 3 and self._more():
                continue  # the number may go on, as in 1|e-6
            self._at = end
            return value

    def array(self) -> Iterator[Any]:
        """The entries of the array that starts here."""
        for _ in self._entries("[", "]"):
            yield self.value()

    def members(self) -> Iterator[str]:
        """The keys of the object that starts here; the caller steps over each value before asking for the next key."""
        for _ in self._entries("{", "}"):
            if self.peek() != '"':
                raise self._fault("expected a key in double quotes")
            key = str(self.value())
            self.take(":")
            yield key

    def _entries(self, opening: str, closing: str) -> Iterator[None]:
        """Stop at the beginning of each entry between two brackets; the caller steps over it."""
        self.take(opening)
        if self.peek() != closing:
            yield
            while self.peek() == ",":
                self.take(",")
                yield
        self.take(closing)

    def end(self) -> None:
        """Check that the text ends here."""
        if self.peek():
            raise self._fault("expected the end of the file")

    def _more(self) -> bool:
        """Read the next piece, at least doubling the buffer; False at the end of the text."""
        if self._ended:
            return False
        rest = self._text[self._at :]
        try:
            piece = self._file.read(max(self._piece, len(rest)))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self._name}: expected JSON in UTF-8: {error}") from error
        if not piece:
            self._ended = True
            return False
        self._before += self._at
        self._text, self._at = rest + piece, 0
        return True

    def _fault(self, what: str) -> InputError:
        here = self._before + self._at
        got = "the file ends" if self._at >= len(self._text) else f"got {self._text[self._at : self._at + 20]!r}"
        return InputError(f"{self._name}: character {here}: {what}, {got}")


def parsed_json(text: str | bytes, where: str) -> Any:
    """The value of a whole JSON text. Raises `InputError` that begins with `where` for broken and too deep ones."""
    try:
        return _decoder.decode(text if isinstance(text, str) else text.decode("utf-8"))
    except RecursionError as error:
        raise InputError(f"{where}: broken or truncated JSON: nested too deeply") from error
    except ValueError as error:
        raise InputError(f"{where}: broken or truncated JSON: {error}") from error


def open_json(path: Path) -> TextIO:
    """Open a JSON file for a `JsonStream`; raises `InputError` if it cannot be opened."""
    return open_text(path, encoding="utf-8-sig")


_PROBLEM = "expected NumPy's format, with plain arrays"


def load_array(file: BinaryIO) -> NDArray[Any]:
    """The array of a .npy file. Raises `InputError` for anything else."""
    with _plain_arrays():
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return _as_doubles(loaded)
    raise InputError("expected a single array, got an archive")


def load_archive(path: Path, wanted: Collection[str] | None = None) -> tuple[set[str], dict[str, NDArray[Any]]]:
    """Names of all arrays of a .npz file, and those `wanted` (None: all).

    It is read in a child process, since its arrays may be compressed. Raises `InputError` naming the file for anything
    else.
    """
    names, *arrays = isolated(_PROBLEM, _archive, path, None if wanted is None else set(wanted))
    return set(names), dict(arrays)


def _archive(path: Path, wanted: Collection[str] | None) -> Iterator[Any]:
    """The names of all arrays; then name and content of each that is wanted."""
    with error_context(str(path)), open_bytes(path) as file, _plain_arrays():
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            raise InputError("expected a NumPy archive of plain arrays, got a single array")
        yield loaded.files
        for name in loaded.files:
            if wanted is None or name in wanted:
                yield name, _as_doubles(loaded[name])


@contextmanager
def _plain_arrays() -> Iterator[None]:
    """Errors about what is no plain array."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # NumPy's reader raises many types for broken files
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # NumPy would advise to trust the file
            raise InputError("expected NumPy's format, with plain arrays and no pickled objects") from error
        raise InputError(f"{_PROBLEM}: {reason}") from error


def _as_doubles(array: NDArray[Any]) -> NDArray[Any]:
    """Floats of any width as doubles; a signalling NaN becomes a quiet one without a warning."""
    with np.errstate(invalid="ignore"):
        return array.astype(np.float64, copy=False) if array.dtype.kind == "f" else array


SUFFIXES = (".parquet", ".feather", ".arrow")
NUMBERS, WHOLE = "iuf", "iu"  # kinds of NumPy's types


def arrow_names(path: Path) -> list[str]:
    """The columns of a Parquet file (.parquet), or a Feather or Arrow file (other suffixes).

    Raises `InputError` for a file that is not readable or has two columns of one name, `MissingExtraError` without
    pyarrow.
    """
    require_extra("parquet", f"{path}: {_kind(path)}", "pyarrow")
    (names,) = isolated(f"expected a readable {_kind(path)} file", _names, path)
    if len(set(names)) != len(names):
        raise InputError(f"{path}: expected every column once, got {', '.join(name[:40] for name in names)[:500]}")
    return list(names)


def arrow_columns(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Some columns of such a file.

    A column of numbers that are all there is an array (N,); any other a list of N values, dates and times as text of
    ISO 8601, None where there is no value. Raises `InputError` for a file that is not readable.
    """
    return {name: column for name, column, _ in _read(path, names, False)}


def arrow_arrays(
    path: Path,
    columns: Sequence[str],
    kinds: Mapping[str, str],
    gaps: Collection[str] = (),
    optional: Sequence[str] = (),
) -> dict[str, Any]:
    """Some columns of such a file as arrays (N,), NaN or None where there is no value.

    kinds     kinds of NumPy's types that a column may have, `NUMBERS` for those not named
    gaps      those of the columns that need not have a value in every row
    optional  further columns, which may be missing and may have gaps

    Raises as `arrow_names` does, and `InputError` naming the file and the column.
    """
    there = arrow_names(path)
    for name in columns:
        if name not in there:
            raise InputError(f"{path}: {name}: expected this column, the file has {', '.join(there)[:200]}")
    found = {}
    for name, column, missing in list(_read(path, [*columns, *(name for name in optional if name in there)], True)):
        if missing and name not in (*gaps, *optional):
            raise InputError(f"{path}: {name}: expected a value in every row")
        allowed = kinds.get(name, NUMBERS)
        if column.dtype.kind not in allowed:
            expected = {NUMBERS: "numbers", WHOLE: "whole numbers"}.get(allowed, "text")
            raise InputError(f"{path}: {name}: expected {expected}, got {column.dtype}")
        if column.dtype.kind == "O":
            row = next((k for k, value in enumerate(column) if not isinstance(value, str | None)), None)
            if row is not None:
                raise InputError(f"{path}: {name}: row {row + 1}: expected text, got {str(column[row])[:40]!r}")
        found[name] = column
    return found


def _kind(path: Path) -> str:
    return "Parquet" if path.suffix.lower() == ".parquet" else "Feather"


def _read(path: Path, names: Sequence[str], arrays: bool) -> Iterator[tuple[str, Any, int]]:
    """Names, values and numbers of missing values of the columns."""
    return isolated(f"expected a readable {_kind(path)} file", _columns, path, list(names), arrays)


def _names(path: Path) -> Iterator[list[str]]:
    from pyarrow import ArrowInvalid, feather, ipc, parquet

    with open_bytes(path) as file:
        if path.suffix.lower() == ".parquet":
            names = parquet.ParquetFile(file).schema_arrow.names
        else:
            try:
                names = ipc.open_file(file).schema.names
            except ArrowInvalid:  # the first version of Feather, or a file whose fault its reader tells
                file.seek(0)
                names = feather.read_table(file, memory_map=False).column_names
    yield list(names)


def _columns(path: Path, names: list[str], arrays: bool) -> Iterator[tuple[str, Any, int]]:
    from pyarrow import feather, parquet

    with open_bytes(path) as file:
        if path.suffix.lower() == ".parquet":
            table = parquet.ParquetFile(file).read(columns=names)
        else:
            table = feather.read_table(file, memory_map=False).select(names)
        table.validate(full=True)
    for name in names:
        yield name, table[name].to_numpy() if arrays else _values(table[name]), table[name].null_count


def _values(column: Any) -> np.ndarray[Any, Any] | list[Any]:
    kind = str(column.type)
    if kind.startswith("timestamp"):
        column = column.cast("timestamp[us]")
    elif not column.null_count and not kind.startswith(("string", "large_string", "null", "dictionary", "date")):
        return np.asarray(column.to_numpy())
    return [value.isoformat() if isinstance(value, date) else value for value in column.to_pylist()]
