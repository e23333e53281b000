"""Reading text files of numbers: lines of values, separated by spaces or commas."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.files.input_files import read_text
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray

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
    def of(cls, path: Path, rows: list[list[str]], line: list[int], columns: int = 0) -> TextTable:
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
        if bad.any():
            row = int(np.argmax(bad))
            raise self.fault(row, f"{name}: expected a whole number from {smallest} to {largest}, got {text[row][:40]}")
        return numbers

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
    return TextTable.of(path, rows, numbers, columns[0])


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
