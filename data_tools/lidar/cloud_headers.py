"""Validation of PCD and PLY files before Open3D reads them.

A wrong header makes a C++ reader read or allocate out of bounds. Therefore every number in the header is checked, and
that the file contains the announced points.

Sources: https://pointclouds.org/documentation/tutorials/pcd_file_format.html and
http://paulbourke.net/dataformats/ply.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NoReturn

from saga_fg.errors import InputError

_PCD_KEYS = ("FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "DATA")
_PCD_TYPES = {("F", 4), ("F", 8), *((kind, size) for kind in "IU" for size in (1, 2, 4, 8))}
_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
LONGEST_HEADER = 20_000  # bytes
LONGEST_LINE = 1000  # of a header, bytes
LONGEST_WORD = 100  # bytes; RPly, which reads PLY files for Open3D, writes beyond its buffer from 256 on
MOST_VALUES = 100  # of a point


def check_pcd(content: bytes) -> None:
    """Raises `InputError` where the header of a PCD file is broken or promises more than there is."""
    lines, body = _header(content, b"DATA")
    found: dict[str, list[str]] = {}
    for line in lines:
        key, *values = line.split() or ["#"]
        if not key.startswith("#"):
            found[key] = values
    missing = [key for key in _PCD_KEYS if key not in found and key != "COUNT"]
    if missing:
        _fault(f"a line {missing[0]}")
    fields = found["FIELDS"]
    sizes, counts = (
        _numbers(key, found.get(key, ["1"] * len(fields)), len(fields), 8 if key == "SIZE" else MOST_VALUES)
        for key in ("SIZE", "COUNT")
    )
    if len(found["TYPE"]) != len(fields) or not {"x", "y", "z"} <= set(fields):
        _fault("fields x, y and z, and a TYPE for each")
    if not set(zip(found["TYPE"], sizes, strict=True)) <= _PCD_TYPES:
        _fault("types F of 4 or 8 bytes, I or U of 1 to 8")
    if any(count != 1 for name, count in zip(fields, counts, strict=True) if name in ("x", "y", "z")):
        _fault("one x, one y and one z a point")
    width, height, points = (_numbers(key, found[key], 1, 2**31 - 1, 0)[0] for key in ("WIDTH", "HEIGHT", "POINTS"))
    if points != width * height:
        _fault("POINTS to be WIDTH x HEIGHT")
    size = points * sum(size * count for size, count in zip(sizes, counts, strict=True))
    kind = found["DATA"][:1]
    if kind == ["ascii"]:
        _rows(body, points, sum(counts))
    elif kind == ["binary"]:
        _room(body, size)
    elif kind == ["binary_compressed"]:
        packed, unpacked = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, -1)
        if unpacked != size:
            _fault(f"{size} bytes of compressed points")
        _room(body[8:], packed)
    else:
        _fault("DATA to be ascii, binary or binary_compressed")


def check_ply(content: bytes) -> None:
    """Raises `InputError` where the header of a PLY file is broken or promises more than there is."""
    lines, body = _header(content, b"end_header")
    words = [line.split() for line in lines if line.split() and line.split()[0] not in ("comment", "obj_info")]
    if not words or words[0] != ["ply"] or len(words) < 2 or words[1][:1] != ["format"] or len(words[1]) != 3:
        _fault("the lines ply and format")
    form = words[1][1]
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        _fault("the format ascii, binary_little_endian or binary_big_endian")
    if words[-1] != ["end_header"]:
        _fault("a line with end_header alone")
    if len(words) < 4 or words[2][:2] != ["element", "vertex"] or len(words[2]) != 3:
        _fault("vertices as the first element")
    (points,) = _numbers("element vertex", words[2][2:], 1, 2**31 - 1, 0)
    properties = []
    for line in words[3:-1]:
        if line[0] != "property":
            break
        if len(line) != 3 or line[1] not in _PLY_SIZES:
            _fault("vertices with properties of one number each")
        properties.append(line)
    names = [line[2] for line in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names) or len(names) > MOST_VALUES:
        _fault("properties x, y and z, and each once")
    if any(line[:1] == ["element"] and _numbers("element", line[2:], 1, 2**31 - 1, 0) != [0] for line in words[3:]):
        _fault("vertices alone")
    if form == "ascii":
        _rows(body, points, len(properties))
    else:
        _room(body, points * sum(_PLY_SIZES[line[1]] for line in properties))


def _header(content: bytes, last: bytes) -> tuple[list[str], bytes]:
    """The lines up to the one that begins with `last`, and what follows."""
    lines, at = [], 0
    while at < min(len(content), LONGEST_HEADER):
        end = content.find(b"\n", at)
        end = len(content) if end < 0 else end
        line = content[at:end]
        at = end + 1
        if not line.isascii() or b"\0" in line:
            _fault("a header of plain text")
        if len(line) > LONGEST_LINE or max(map(len, line.split()), default=0) > LONGEST_WORD:
            _fault(f"a header with lines of at most {LONGEST_LINE} and words of at most {LONGEST_WORD} bytes")
        lines.append(line.decode("ascii").rstrip("\r"))
        if line.startswith(last):
            return lines, content[at:]
    raise InputError(f"expected a header that ends in a line {last.decode()}")


def _numbers(what: str, words: Sequence[str], count: int, most: int, least: int = 1) -> list[int]:
    if len(words) != count or not all(word.isdigit() and least <= int(word[:20]) <= most for word in words):
        _fault(f"{what} to be {count} whole numbers from {least} to {most}")
    return [int(word) for word in words]


def _rows(body: bytes, points: int, values: int) -> None:
    rows = [line.split() for line in body.splitlines() if line.strip()]
    if len(rows) < points or any(len(row) != values for row in rows[:points]):
        _fault(f"{points} lines of {values} numbers after the header")
    if any(len(word) > LONGEST_WORD for row in rows[:points] for word in row):
        _fault(f"numbers of at most {LONGEST_WORD} bytes after the header")
    try:
        for row in rows[:points]:
            for word in row:
                float(word)
    except ValueError:
        _fault("numbers after the header")


def _room(body: bytes, size: int) -> None:
    if len(body) < size:
        _fault(f"{size} bytes after the header, there are {len(body)}")


def _fault(expected: str) -> NoReturn:
    raise InputError(f"expected {expected}")
