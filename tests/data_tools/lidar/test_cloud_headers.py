"""Headers of point clouds that promise what is not there never reach Open3D, where they crash the interpreter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.lidar import read_scan
from saga_fg import InputError
from tests.data_tools.damage import PCD, PLY

BINARY = PCD.replace("DATA ascii\n1 2 3\n4 5 6\n", "DATA binary\n").encode() + np.arange(6, dtype="<f4").tobytes()


def test_a_wrong_pcd_header_is_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for before, after, message in [
        ("COUNT 1 1 1", "COUNT -1 1 1", "COUNT to be 3 whole numbers from 1"),
        ("COUNT 1 1 1", "COUNT 2 1 1", "one x, one y and one z"),
        ("SIZE 4 4 4", "SIZE 4 4", "SIZE to be 3 whole numbers"),
        ("TYPE F F F", "TYPE F F X", "types F of 4 or 8 bytes"),
        ("FIELDS x y z", "FIELDS x y w", "fields x, y and z"),
        ("WIDTH 2", "WIDTH 99999999999", "WIDTH to be 1 whole numbers"),
        ("POINTS 2", "POINTS 3", "POINTS to be WIDTH x HEIGHT"),
        ("4 5 6", "4 5", "2 lines of 3 numbers"),
        ("4 5 6", "4 five 6", "2 lines of 3 numbers after the header"),
        ("DATA ascii", "DATA cuneiform", "DATA to be ascii, binary"),
        ("HEIGHT 1\n", "", "a line HEIGHT"),
    ]:
        with subtests.test(message):
            path = tmp_path / "scan.pcd"
            path.write_text(PCD)
            np.testing.assert_array_equal(read_scan(path).points, [[1, 2, 3], [4, 5, 6]])
            assert before in PCD
            path.write_text(PCD.replace(before, after))
            with pytest.raises(InputError, match=message):
                read_scan(path)


def test_binary_points_have_to_be_there(tmp_path: Path) -> None:
    path = tmp_path / "scan.pcd"
    path.write_bytes(BINARY)
    np.testing.assert_array_equal(read_scan(path).points, [[0, 1, 2], [3, 4, 5]])
    path.write_bytes(BINARY[:-1])
    with pytest.raises(InputError, match="24 bytes after the header, there are 23"):
        read_scan(path)


def test_a_wrong_ply_header_is_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for before, after, message in [
        ("element vertex 2", "element vertex 3", "3 lines of 3 numbers"),
        ("element vertex 2", "element vertex -2", "element vertex to be 1 whole numbers"),
        ("element vertex 2", "element face 2", "vertices as the first element"),
        ("property float x", "property list uchar int x", "properties of one number each"),
        ("property float x", "property float w", "properties x, y and z"),
        ("format ascii 1.0", "format sound 1.0", "the format ascii"),
        ("end_header\n", "end_header 1\n", "a line with end_header alone"),
        ("end_header\n", "end_header" + "a" * 5000 + "\n", "a header with lines of at most 1000 and words of at most"),
        ("element vertex", "element " + "v" * 300, "a header with lines of at most 1000 and words of at most"),
        ("end_header", "header", "a header that ends in a line end_header"),
        ("ply\n", "plum\n", "the lines ply and format"),
    ]:
        with subtests.test(message):
            path = tmp_path / "scan.ply"
            path.write_text(PLY)
            np.testing.assert_array_equal(read_scan(path).points, [[1, 2, 3], [4, 5, 6]])
            path.write_text(PLY.replace(before, after, 1))
            with pytest.raises(InputError, match=message):
                read_scan(path)
