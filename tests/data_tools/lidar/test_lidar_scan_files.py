"""Scans from files: every format gives the same points, and damaged files say what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.lidar import Scan, read_scan, write_cloud
from saga_fg.errors import InputError

POINTS = np.array([[1.0, 2.0, 3.0], [-4.5, 0.25, -1.75], [10.0, -20.0, 0.5]])
INTENSITY = np.array([0.0, 0.5, 0.25])
PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 4
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4
DATA ascii
1 2 3 0
-4.5 0.25 -1.75 0.5
nan nan nan 0
10 -20 0.5 0.25
"""
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float intensity
end_header
1 2 3 0
-4.5 0.25 -1.75 0.5
10 -20 0.5 0.25
"""


def written(folder: Path, name: str) -> Path:
    path = folder / name
    match name:
        case "scan.bin":
            np.column_stack([POINTS, INTENSITY]).astype("<f4").tofile(path)
        case "scan.pcd.bin":
            np.column_stack([POINTS, INTENSITY, [0, 1, 31]]).astype("<f4").tofile(path)
        case "scan.pcd":
            path.write_text(PCD)
        case "scan.ply":
            path.write_text(PLY)
        case "scan.npy":
            np.save(path, np.column_stack([POINTS, INTENSITY]))
        case "scan.npz":
            np.savez(path, points=POINTS, intensity=INTENSITY, time=[0.0, 0.01, 0.02])
    return path


@pytest.mark.parametrize("name", ["scan.bin", "scan.pcd.bin", "scan.pcd", "scan.ply", "scan.npy", "scan.npz"])
def test_every_format_gives_the_same_points(tmp_path: Path, name: str) -> None:
    scan = read_scan(written(tmp_path, name))
    np.testing.assert_allclose(scan.points, POINTS)
    np.testing.assert_allclose(scan.intensity, INTENSITY)
    assert (scan.time is not None) == (name == "scan.npz")


@pytest.mark.parametrize("name", ["scan.ply", "scan.npy"])
def test_points_without_intensity_have_none(tmp_path: Path, name: str) -> None:
    if name == "scan.ply":
        write_cloud(tmp_path / name, POINTS, np.full((3, 3), 200, dtype=np.uint8))
    else:
        np.save(tmp_path / name, POINTS)
    scan = read_scan(tmp_path / name)
    np.testing.assert_allclose(scan.points, POINTS)
    assert np.isnan(scan.intensity).all()


def test_damaged_files_say_what_is_wrong(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for name, content, expected in [
        ("a.bin", b"123456", r"a\.bin: expected records of 16 bytes .* got 6 bytes"),
        ("a.bin", b"", r"a\.bin: expected records of 16 bytes .* got 0 bytes"),
        ("a.pcd.bin", b"0" * 16, r"a\.pcd\.bin: expected records of 20 bytes"),
        ("a.bin", np.array([np.nan, 0, 0, 0], "<f4").tobytes(), r"a\.bin: points\[0, 0\]: expected a finite number"),
        ("a.npy", b"no array", r"a\.npy: expected NumPy's format, with plain arrays and no pickled"),
        ("a.npz", b"no archive", r"a\.npz: expected NumPy's format, with plain arrays and no pickled"),
        ("a.pcd", b"", r"a\.pcd: expected a header that ends in a line DATA"),
        ("a.pcd", b"rubbish", r"a\.pcd: expected a header that ends in a line DATA"),
        ("a.ply", b"rubbish", r"a\.ply: expected a header that ends in a line end_header"),
        ("a.txt", b"", r"a\.txt: expected a name that ends in \.pcd\.bin, \.bin"),
        ("missing/a.bin", None, r"a\.bin: cannot be read: No such file"),
    ]:
        with subtests.test(expected):
            if content is not None:
                (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match=expected):
                read_scan(tmp_path / name)


def test_a_signalling_nan_is_refused_as_any_other(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((1, 4), 0x7FA00000, dtype="<u4").view("<f4"))
    with pytest.raises(InputError, match=r"a\.npy: points\[0, 0\]: expected a finite number"):
        read_scan(tmp_path / "a.npy")


def test_an_array_of_another_shape_and_an_archive_without_points_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.zeros(6))
    np.savez(tmp_path / "other.npz", xyz=POINTS)
    with pytest.raises(InputError, match=r"expected numbers \(N, 3\) or wider, got float64 \(6,\)"):
        read_scan(tmp_path / "flat.npy")
    with pytest.raises(InputError, match=r"expected the array points"):
        read_scan(tmp_path / "other.npz")


def test_colours_must_fit_the_points(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"colours: expected \(3, 3\) bytes"):
        write_cloud(tmp_path / "a.ply", POINTS, np.zeros((2, 3), dtype=np.uint8))
    assert not list(tmp_path.iterdir())


def test_a_scan_is_checked_and_cut_by_range() -> None:
    scan = Scan(POINTS, INTENSITY, np.array([0.0, 0.1, 0.2]))
    assert scan.within(4.0, 10.0).time.tolist() == [0.1]  # type: ignore[union-attr]
    with pytest.raises(InputError, match=r"intensity: expected shape \(3,\)"):
        Scan(POINTS, INTENSITY[:2])


def test_clouds_are_written_and_read_back(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for suffix in ["ply", "pcd"]:
        with subtests.test(suffix=suffix):
            path = tmp_path / f"a.{suffix}"
            write_cloud(path, POINTS)
            np.testing.assert_array_equal(read_scan(path).points, POINTS)
            write_cloud(tmp_path / "none.ply", np.empty((0, 3)))
            assert len(read_scan(tmp_path / "none.ply")) == 0
            with pytest.raises(InputError, match=r"expected a name that ends in \.ply or \.pcd"):
                write_cloud(tmp_path / "a.las", POINTS)
