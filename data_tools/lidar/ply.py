"""Point clouds as PLY files: what viewers such as MeshLab, CloudCompare and Open3D open.

A text header names the properties of a vertex; the vertices follow as packed little-endian records. Source:
G. Turk, The PLY polygon file format, 1994.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_tools.files.atomic_files import write_bytes
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray, checked


def write_ply(path: str | Path, points: FloatArray, colours: NDArray[np.uint8] | None = None) -> None:
    """Write points (N, 3), m, as float32, and red, green, blue (N, 3) from 0 to 255 if given; atomically.

    Raises `InputError` for positions that are not finite, and for colours of another shape or type.
    """
    points = checked("points", points, (None, 3))
    properties = [(axis, "<f4") for axis in "xyz"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    if colours is not None:
        if colours.shape != points.shape or colours.dtype != np.uint8:
            raise InputError(f"colours: expected {points.shape} bytes, got {colours.dtype} {colours.shape}")
        properties += [(colour, "u1") for colour in ("red", "green", "blue")]
        header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    vertices = np.empty(len(points), dtype=properties)
    for k, axis in enumerate("xyz"):
        vertices[axis] = points[:, k]
    if colours is not None:
        for k, colour in enumerate(("red", "green", "blue")):
            vertices[colour] = colours[:, k]
    write_bytes(path, "\n".join([*header, "end_header", ""]).encode("ascii") + vertices.tobytes())
