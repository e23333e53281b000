"""Reading large JSON files one value at a time.

`json.load` of the tables of a full nuScenes download needs several gigabytes; here only the current entry of the
outermost array or object is in memory. Entries are decoded by the C scanner of the standard library, which accepts the
words NaN and Infinity in result files (ijson, equally fast, refuses them).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from data_tools.files.input_files import open_text
from saga_fg.errors import InputError

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
        self.take("[")
        if self.peek() == "]":
            self.take("]")
            return
        while True:
            yield self.value()
            if self.peek() != ",":
                break
            self.take(",")
        self.take("]")

    def members(self) -> Iterator[str]:
        """The keys of the object that starts here; the caller steps over each value before asking for the next key."""
        self.take("{")
        if self.peek() == "}":
            self.take("}")
            return
        while True:
            if self.peek() != '"':
                raise self._fault("expected a key in double quotes")
            key = str(self.value())
            self.take(":")
            yield key
            if self.peek() != ",":
                break
            self.take(",")
        self.take("}")

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
