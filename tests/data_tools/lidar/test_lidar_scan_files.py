"""Scans from files: every format gives the same points, and damaged files say what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SimulatedScans
from data_tools.lidar import SUFFIXES, Scan, load_open3d, read_scan, write_cloud
from data_tools.lidar.scan_files import relative_times
from saga_fg import InputError, MissingExtraError

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
        write_cloud(tmp_path / name, POINTS)
    else:
        np.save(tmp_path / name, POINTS)
    scan = read_scan(tmp_path / name)
    np.testing.assert_allclose(scan.points, POINTS)
    assert np.isnan(scan.intensity).all()


def test_damaged_files_say_what_is_wrong(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for name, content, expected in [
        ("a.bin", b"123456", r"a\.bin: expected records of 3 to 8 floats, .* the 6 bytes are none, or cut off"),
        ("a.pcd.bin", b"0" * 16, r"a\.pcd\.bin: expected records of 20 bytes"),
        ("a.bin", np.full(8, 1e-30, "<f4").tobytes(), r"a\.bin: expected points in metres, .* the median is 1\.7"),
        ("a.pcd", PCD.replace("10 -20", "1e7 -2e8").replace("1 2 3", "1e5 2 3").encode(), r"the median is 1e\+05"),
        ("a.npy", b"no array", r"a\.npy: expected NumPy's format, with plain arrays and no pickled"),
        ("a.npz", b"no archive", r"a\.npz: expected NumPy's format, with plain arrays and no pickled"),
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


def test_points_without_a_place_are_dropped_and_counted(tmp_path: Path, subtests: pytest.Subtests) -> None:
    rows = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [4, np.inf, 6, 1], [7, 8, 9, np.nan]], dtype="<f4")
    rows[1] = np.full(4, 0x7FA00000, dtype="<u4").view("<f4")  # a signalling NaN
    np.save(tmp_path / "a.npy", rows)
    rows.tofile(tmp_path / "a.bin")
    np.savez(tmp_path / "a.npz", points=rows[:, :3], intensity=rows[:, 3], time=np.arange(4.0) / 100)
    for name in ("a.npy", "a.bin", "a.npz"):
        with subtests.test(name):
            scan = read_scan(tmp_path / name)
            np.testing.assert_array_equal(scan.points, [[1, 2, 3], [7, 8, 9]])
            assert scan.intensity[0] == 0.5
            assert np.isnan(scan.intensity[1])
            assert scan.dropped == 2
    assert scan.time.tolist() == [0.0, 0.03]
    np.tile(np.array([np.nan, np.nan, np.nan, 0.5], dtype="<f4"), (300, 1)).tofile(tmp_path / "a.bin")
    assert (len(read_scan(tmp_path / "a.bin")), read_scan(tmp_path / "a.bin").dropped) == (0, 300)
    for suffix in SUFFIXES:
        (tmp_path / f"none{suffix}").write_bytes(b"")
        assert len(read_scan(tmp_path / f"none{suffix}")) == 0
    np.save(tmp_path / "none.npy", [])
    assert len(read_scan(tmp_path / "none.npy")) == 0


def simulated() -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and times (N,) of a scan."""
    scan = SimulatedScans(0, 2)[0]
    return scan.points, scan.time


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4"])
def test_columns_of_records_without_a_header_are_told(tmp_path: Path, kind: str, subtests: pytest.Subtests) -> None:
    """Whatever their number: a scan of five columns is none of four."""
    points, time = simulated()
    rng = np.random.default_rng(0)
    ring, intensity = np.arange(len(points)) % 24, rng.integers(0, 256, len(points))
    for columns in (
        [points],
        [points, intensity],
        [points, 0 * intensity],
        [points, intensity, ring],
        [points, intensity / 255, ring, time - time[0]],
        [points, rng.normal(size=points.shape)],
        [points, intensity, ring, time - time[0], ring, intensity],
    ):
        table = np.column_stack(columns).astype(kind)
        with subtests.test(columns=table.shape[1]):
            table[: len(table) // 120 * 120].tofile(tmp_path / "a.bin")
            scan = read_scan(tmp_path / "a.bin")
            np.testing.assert_array_equal(scan.points, table[: len(scan), :3].astype(np.float64))
            assert len(scan) == len(table) // 120 * 120
            assert (scan.time is not None) == (len(columns) > 3)
            for cut in (1, 4, 8):
                (tmp_path / "cut.bin").write_bytes((tmp_path / "a.bin").read_bytes()[:-cut])
                with pytest.raises(InputError, match=r"cut\.bin: expected records .*, or cut off"):
                    read_scan(tmp_path / "cut.bin")


def test_what_is_no_scan_does_not_become_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for content in (rng.bytes(12000), b"plain text " * 1200, rng.integers(0, 9, 3000).astype("<i4").tobytes()):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.bin: expected"):
            read_scan(tmp_path / "a.bin")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.pcd", {}),
        ("b.pcd", {"compressed": True}),
        ("c.pcd", {"write_ascii": True}),
        ("d.ply", {}),
        ("e.ply", {"write_ascii": True}),
    ],
)
def test_clouds_that_open3d_wrote_keep_the_times_of_their_points(
    tmp_path: Path, name: str, options: dict[str, bool]
) -> None:
    points, time = simulated()
    open3d = load_open3d()
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points.astype(np.float32)))
    cloud.point["intensity"] = open3d.core.Tensor(points[:, :1].astype(np.float32))
    cloud.point["timestamp"] = open3d.core.Tensor(time[:, None])
    assert open3d.t.io.write_point_cloud(str(tmp_path / name), cloud, **options)
    scan = read_scan(tmp_path / name)
    np.testing.assert_allclose(scan.points, points, atol=1e-4)
    np.testing.assert_allclose(scan.intensity, points[:, 0], atol=1e-4)
    np.testing.assert_allclose(scan.time, time, atol=1e-5)


def test_surveyors_files_are_read_by_laspy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.las").write_bytes(b"LASF")
    with monkeypatch.context() as patch:
        patch.setattr("data_tools.lidar.scan_files.find_spec", lambda name: None)
        with pytest.raises(MissingExtraError, match=r"need laspy: pip install 'saga-fg\[las\]'"):
            read_scan(tmp_path / "a.las")
    laspy = pytest.importorskip("laspy")
    points, time = simulated()
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = [1e-4] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.intensity, cloud.gps_time = np.arange(len(points)) % 256, 1e9 + time
    cloud.write(str(tmp_path / "b.las"))
    scan = read_scan(tmp_path / "b.las")
    np.testing.assert_allclose(scan.points, points, atol=1e-4)
    np.testing.assert_allclose(scan.time, time - time[0], atol=1e-6)
    assert scan.intensity[:3].tolist() == [0, 1, 2]
    with pytest.raises(InputError, match=r"a\.las: expected a header of LAS, with its records in the 4 bytes"):
        read_scan(tmp_path / "a.las")
    for cut in (100, 10 * cloud.header.point_format.size):
        (tmp_path / "c.las").write_bytes((tmp_path / "b.las").read_bytes()[:-cut])
        with pytest.raises(InputError, match=r"c\.las: expected"):
            read_scan(tmp_path / "c.las")


@pytest.mark.parametrize(
    ("values", "stamp", "first", "last"),
    [
        (np.array([0, 50_000_000, 100_000_000], dtype=np.uint32), 5.0, 0.0, 0.1),  # ns, Ouster
        (np.array([-0.1, -0.05, 0.0], dtype=np.float32), 5.0, -0.1, 0.0),  # s, Velodyne
        (np.array([1.7e9, 1.7e9 + 0.1]), 1.7e9 + 0.05, -0.05, 0.05),  # the clock of the header, Hesai
        (np.array([0.2, 0.3]), 1.7e9, 0.2, 0.3),
        (np.array([1.7e9, 1.7e9 + 0.1]), 3.0, 0.0, 0.1),  # another clock than that of the header
        (np.array([1700000000000000000, 1700000000100000000]), 1.7e9, 0.0, 0.1),
        (np.array([0.0, 100.0]), None, 0.0, 0.1),  # ms
        (np.array([0, 100_000]), None, 0.0, 0.1),  # us
    ],
)
def test_times_of_points_have_the_unit_that_a_turn_takes(
    values: np.ndarray, stamp: float | None, first: float, last: float
) -> None:
    found = relative_times(values, stamp)
    np.testing.assert_allclose(found[[0, -1]], [first, last], atol=1e-6)


def test_times_that_are_one_are_none_and_too_long_ones_an_error() -> None:
    assert relative_times(np.zeros(5)) is None
    with pytest.raises(InputError, match="time: expected the times of one scan, in s, ms, us or ns, they span 1e"):
        relative_times(np.array([0.0, 1e12]))


def test_an_array_of_another_shape_and_an_archive_without_points_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.zeros(6))
    np.savez(tmp_path / "other.npz", xyz=POINTS)
    with pytest.raises(InputError, match=r"expected numbers \(N, 3\) or wider, got float64 \(6,\)"):
        read_scan(tmp_path / "flat.npy")
    with pytest.raises(InputError, match=r"expected the array points"):
        read_scan(tmp_path / "other.npz")


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
