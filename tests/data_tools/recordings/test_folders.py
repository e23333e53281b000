"""Folders of scans: every format, times from names and tables, layouts of datasets, and what is wrong in one."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SMALL, SimulatedScans, drive, simulate_scan, street
from data_tools.lidar import Scan
from data_tools.recordings import RecordingOptions, open_recording
from data_tools.recordings.layouts import GROUP
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.parts import offered
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import write_tables
from tests.data_tools.scans_example import BEGIN, FOLDERS, write_scan, write_scans

KINDS = [kind for kind in FOLDERS if kind != "las" or find_spec("laspy") is not None]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    taken = SimulatedScans(0, 4)
    return [taken[k] for k in range(len(taken))]


TIMES = BEGIN + 0.1 * np.arange(4)


@pytest.mark.parametrize("kind", KINDS)
def test_every_format_is_read_with_the_times_of_its_names(tmp_path: Path, scans: list[Scan], kind: str) -> None:
    found = open_recording(write_scans(tmp_path / "scans", kind, scans, TIMES))
    assert found.layout == "folder"
    np.testing.assert_allclose(found.timestamps, TIMES, atol=1e-6)
    assert found.world_T_ego is None
    for k, scan in enumerate(scans):
        np.testing.assert_allclose(found[k].points, scan.points, atol=1e-5)
        if kind in ("pcd", "ply", "npz", "las"):
            np.testing.assert_allclose(found[k].time, scan.time, atol=1e-7)
        else:
            assert found[k].time is None
    assert open_recording(tmp_path / "scans", RecordingOptions(timed=False, most=2))[1].time is None


def test_times_of_points_by_the_clock_of_the_names_are_relative_to_these(tmp_path: Path, scans: list[Scan]) -> None:
    """Those of a scan that begins before its stamp; offsets stay offsets where stamps begin at 0."""
    for name, begin in (("of a clock", BEGIN), ("offsets", 0.0)):
        stamps = begin + 0.1 * np.arange(1, 5)
        taken = [replace(scan, time=scan.time + bool(begin) * stamps[k]) for k, scan in enumerate(scans)]
        found = open_recording(write_scans(tmp_path / name, "npz", taken, stamps))
        for k, scan in enumerate(scans):
            np.testing.assert_allclose(found[k].time, scan.time, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1403715273262142976", "1403715273362142976"], [1403715273.262143, 1403715273.362143]),
        (
            ["n015-2018-07-24__LIDAR_TOP__1532402927647951", "n015__LIDAR_TOP__1532402927747951"],
            [1532402927.647951] * 2,
        ),
        (["cloud_1583836591_182590976", "cloud_1583836591_282590976"], [1583836591.182591, 1583836591.282591]),
        (["0.25", "10.5"], [0.25, 10.5]),
        (["1625000000.500000", "1625000000.600000"], [1625000000.5, 1625000000.6]),
        (["scan_0", "scan_1", "scan_3"], [0.0, 0.1, 0.3]),
        (["a", "b"], [0.0, 0.1]),
    ],
)
def test_times_in_names(tmp_path: Path, scans: list[Scan], names: list[str], times: list[float]) -> None:
    for name in names:
        write_scan(tmp_path / f"{name}.bin", scans[0], timed=False)
    found = open_recording(tmp_path).timestamps
    np.testing.assert_allclose(found[0], times[0], atol=1e-6)
    if times[0] != times[1]:
        np.testing.assert_allclose(found, times, atol=1e-6)


@pytest.mark.parametrize(
    "table",
    [
        "0.0\n0.1\n0.25\n",
        "# s\n\n0.0\n0.1\n0.25\n",
        "name,time\n000000.bin,0.0\n000001.bin,0.1\n000002.bin,0.25\n",
        "000002 0.25\n000001 0.1\n000000 0.0\n",
        "1700000000000000000\n1700000000100000000\n1700000000250000000\n",
        "2011-09-26 13:02:25.000000000\n2011-09-26 13:02:25.100000000\n2011-09-26 13:02:25.250000000\n",
        "time\n2011-09-26T13:02:25Z\n2011-09-26T13:02:25.1Z\n2011-09-26T14:02:25.25+01:00\n",
    ],
)
def test_times_of_a_table(tmp_path: Path, scans: list[Scan], table: str) -> None:
    (tmp_path / "data").mkdir()
    for k in range(3):
        write_scan(tmp_path / "data" / f"{k:06d}.bin", scans[k], timed=False)
    for place in (tmp_path / "data" / "times.csv", tmp_path / "timestamps.txt"):
        place.write_text(table)
        found = open_recording(tmp_path / "data")
        np.testing.assert_allclose(found.timestamps - found.timestamps[0], [0, 0.1, 0.25], atol=1e-6)
        place.unlink()


@pytest.mark.parametrize(
    ("stems", "table"),
    [
        ([str(k) for k in range(1, 13)], "{time}\n"),
        ([f"{k}_top" for k in range(1, 13)], "{time}\n"),
        ([f"run_2_scan_{k}" for k in range(1, 13)], ""),
        ([f"{k}_top" for k in range(1, 13)], ""),
        ([f"0.{k:02d}" for k in range(1, 13)], "{time}\n"),
        ([str(k) for k in range(12, 0, -1)], "{stem}.bin {time}\n"),
    ],
)
def test_scans_are_in_the_order_of_their_numbers_or_of_named_times(
    tmp_path: Path, scans: list[Scan], stems: list[str], table: str
) -> None:
    for stem in stems:
        write_scan(tmp_path / f"{stem}.bin", scans[0], timed=False)
    for folder in (tmp_path, tmp_path / "velodyne"):  # also that of KITTI
        if folder != tmp_path:
            if not table.startswith("{time}"):
                break
            folder.mkdir()
            for stem in stems:
                (tmp_path / f"{stem}.bin").rename(folder / f"{stem}.bin")
        if table:
            lines = [table.format(stem=stem, time=0.1 * k) for k, stem in enumerate(stems)]
            (tmp_path / "times.txt").write_text("".join(lines))
        found = open_recording(tmp_path)
        assert [Path(found.place(row)).name.removesuffix(".bin") for row in range(12)] == stems
        np.testing.assert_allclose(found.timestamps, 0.1 * np.arange(12), atol=1e-9)


def folder_of(folder: Path, scans: list[Scan], count: int = 3) -> Path:
    folder.mkdir()
    for k in range(count):
        write_scan(folder / f"{k:06d}.bin", scans[k], timed=False)
    return folder


def test_what_is_wrong_in_a_folder_is_one_line(
    tmp_path: Path, scans: list[Scan], subtests: pytest.Subtests, caplog: pytest.LogCaptureFixture
) -> None:
    with subtests.test("empty folder"):
        (tmp_path / "empty").mkdir()
        with pytest.raises(InputError, match=r"empty: expected scans \.pcd\.bin, .* there are none"):
            open_recording(tmp_path / "empty")
        with pytest.raises(InputError, match=r"missing: expected a recording of scans, there is no such file"):
            open_recording(tmp_path / "missing")
    with subtests.test("bag of ROS 1"):
        (tmp_path / "empty" / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
        with pytest.raises(InputError, match=r"convert that of ROS 1 first: rosbags-convert"):
            open_recording(tmp_path / "empty")
    folder = folder_of(tmp_path / "times", scans)
    for times, message in [
        ("0.0\n0.2\n0.1\n", r"times\.txt: line 3: time: expected one after 0\.200000 s, .* got 0\.1"),
        ("0.0\n0.2\n", r"times\.txt: expected 3 times, one for each scan, got 2"),
        ("0.0\nsoon\n0.2\n", r"times\.txt: line 2: expected a time, got 'soon'"),
    ]:
        (folder / "times.txt").write_text(times)
        with subtests.test(message), pytest.raises(InputError, match=message):
            open_recording(folder)
    with subtests.test("formats mixed"):
        folder = folder_of(tmp_path / "mixed", scans)
        write_scan(folder / "000003.npy", scans[3], timed=False)
        with pytest.raises(InputError, match=r"expected scans of one format, there are \.bin, \.npy"):
            open_recording(folder)
    with subtests.test("two sensors"):
        folder = folder_of(tmp_path / "two", scans, 0)
        for name in ("front_0", "front_1", "rear_0", "rear_1"):
            write_scan(folder / f"{name}.bin", scans[0], timed=False)
        with pytest.raises(InputError, match=r"different numbers, got 0 twice: front_0\.bin and rear_0\.bin"):
            open_recording(folder)
    with subtests.test("empty scan"):
        folder = folder_of(tmp_path / "hole", scans)
        (folder / "000001.bin").write_bytes(b"")
        assert [len(open_recording(folder)[k]) > 0 for k in range(3)] == [True, False, True]
    with subtests.test("last scan cut off"):
        folder = folder_of(tmp_path / "cut", scans)
        whole = (folder / "000002.bin").read_bytes()
        (folder / "000002.bin").write_bytes(whole[: len(whole) // 2 - 1])
        assert len(open_recording(folder)) == 2
        assert "000002.bin: expected records" in caplog.text
        assert "or cut off; the last scan is left out" in caplog.text
    with subtests.test("a scan cut off amid others"):
        write_scan(folder / "000003.bin", scans[3], timed=False)
        with pytest.raises(InputError, match=r"000002\.bin: expected records .* or cut off"):
            open_recording(folder)[2]
    with subtests.test("other columns"):
        folder = folder_of(tmp_path / "columns", scans, 2)
        points = scans[2].points
        rng = np.random.default_rng(0)
        np.column_stack([points, rng.random(len(points)), np.arange(len(points)) % 24]).astype("<f4").tofile(
            folder / "000002.bin"
        )
        write_scan(folder / "000003.bin", scans[3], timed=False)
        with pytest.raises(InputError, match=r"000002\.bin: expected the columns x, y, z, intensity of the scans"):
            open_recording(folder)[2]


@pytest.mark.parametrize("rear", [yaw_transform(-2.0, yaw=np.pi), yaw_transform(0.0, 1.0, yaw=np.pi / 2)])
def test_scans_of_two_sensors_in_turn_are_refused(tmp_path: Path, rear: np.ndarray) -> None:
    rng, world = np.random.default_rng(0), street(0)
    poses = [pose @ (rear if k % 2 else np.eye(4)) for k, pose in enumerate(drive(24))]
    taken = [simulate_scan(world, pose, rng, SMALL) for pose in poses]
    found = open_recording(write_scans(tmp_path / "two", "npz", taken, 0.1 * np.arange(24)))
    with pytest.raises(InputError, match=r"\.npz: expected scans of one sensor: 6 of the last 20"):
        [found[k] for k in range(len(found))]
    alone = open_recording(write_scans(tmp_path / "one", "npz", taken[::2], 0.1 * np.arange(12)))
    assert all(len(alone[k]) for k in range(len(alone)))


def test_kitti_s_layouts(tmp_path: Path, scans: list[Scan], caplog: pytest.LogCaptureFixture) -> None:
    root = write_sequence(tmp_path / "tracking")
    folder = root / "training" / "velodyne" / "0007"
    folder.mkdir(parents=True)
    for k in range(3):
        write_scan(folder / f"{k:06d}.bin", scans[k], timed=False)
    found = open_recording(root)
    assert found.layout == "kitti-tracking"
    assert set(found.sensors()) == {"imu", "wheels", "gps"}
    np.testing.assert_allclose(found.world_T_ego[2, :3, 3], [2, 0, 0], atol=1e-6)
    assert found[0].time is not None
    sequence = tmp_path / "odometry" / "sequences" / "07"
    (sequence / "velodyne").mkdir(parents=True)
    (tmp_path / "odometry" / "poses").mkdir()
    for k in range(3):
        write_scan(sequence / "velodyne" / f"{k:06d}.bin", scans[k], timed=False)
    (sequence / "times.txt").write_text("0.0\n1.037875e-01\n2.075750e-01\n")
    (sequence / "calib.txt").write_text("P0: " + "1 0 0 0 " * 3 + "\nTr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n")
    (tmp_path / "odometry" / "poses" / "07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(3)))
    for source in (tmp_path / "odometry", sequence):
        found = open_recording(source)
        assert found.layout == "kitti-odometry"
        np.testing.assert_allclose(found.timestamps, [0, 0.1037875, 0.207575])
        np.testing.assert_allclose(found.world_T_ego[:, :3, 3], [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-9)
        assert found[1].time is None
    with pytest.raises(InputError, match="--sequence: unknown sequence '08', expected one of: 07"):
        open_recording(tmp_path / "odometry", RecordingOptions("08"))


def ns(k: int) -> int:
    return round(TIMES[k] * 1e9)


def test_layouts_of_other_datasets(tmp_path: Path, scans: list[Scan], subtests: pytest.Subtests) -> None:
    """As their specifications say: the originals are not here."""
    full = Scan(np.tile(scans[0].points, (20, 1))[:65536], np.zeros(65536))
    with subtests.test("MulRan"):
        root = tmp_path / "mulran"
        (root / "Ouster").mkdir(parents=True)
        for k in range(2):
            write_scan(root / "Ouster" / f"{ns(k)}.bin", full, timed=False)
        (root / "global_pose.csv").write_text(
            "".join(f"{ns(k)},1,0,0,{332000 + k},0,1,0,4027000,0,0,1,20\n" for k in range(2))
        )
        found = open_recording(root)
        assert found.layout == "mulran"
        np.testing.assert_allclose(found.world_T_ego[1, :3, 3], [1, 0, 0])
        np.testing.assert_allclose(found[0].time[[0, 63, 64, -1]], [0, 0, 1e-1 / 1024, 0.1 * 1023 / 1024])
        np.testing.assert_allclose(found.ego_T_lidar[:3, 3], [1.7042, -0.021, 1.8047])
        np.testing.assert_allclose(found.ego_T_lidar[:2, 0], [-0.99998295, 0.0058398], atol=1e-6)
    with subtests.test("HeLiPR"):
        root = tmp_path / "helipr"
        (root / "LiDAR" / "Velodyne").mkdir(parents=True)
        (root / "LiDAR" / "Avia").mkdir()
        (root / "LiDAR_GT").mkdir()
        points, time = scans[0].points, scans[0].time
        velodyne = np.zeros(len(points), dtype=[("p", "<f4", 4), ("ring", "<u2"), ("time", "<f4")])
        velodyne["p"][:, :3], velodyne["time"] = points, time
        avia = np.zeros(len(points), dtype=[("p", "<f4", 3), ("r", "u1"), ("tag", "u1"), ("line", "u1"), ("t", "<u4")])
        avia["p"], avia["t"] = points, np.round((time - time[0]) * 1e9)
        velodyne.tofile(root / "LiDAR" / "Velodyne" / f"{ns(0)}.bin")
        avia.tofile(root / "LiDAR" / "Avia" / f"{ns(0)}.bin")
        (root / "LiDAR_GT" / "global_Avia_gt.txt").write_text(f"{ns(0)} 332000.5 1 2 0 0 0 1\n")
        with pytest.raises(InputError, match="expected --sequence with a sensor of Avia, Velodyne"):
            open_recording(root)
        for sensor, since in (("Velodyne", time), ("Avia", time - time[0])):
            found = open_recording(root, RecordingOptions(sensor))
            np.testing.assert_allclose(found[0].points, points, atol=1e-5)
            np.testing.assert_allclose(found[0].time, since, atol=1e-7)
        np.testing.assert_allclose(found.world_T_ego[0, :3, 3], [0.5, 0, 0])
    with subtests.test("Newer College"):
        root = tmp_path / "college"
        (root / "raw_format" / "ouster_scan").mkdir(parents=True)
        (root / "ground_truth").mkdir()
        for k in range(2):
            write_scan(
                root / "raw_format" / "ouster_scan" / f"cloud_1583836591_{182590976 + 10**8 * k}.pcd", full, timed=False
            )
        (root / "ground_truth" / "registered_poses.csv").write_text(
            "#sec,nsec,x,y,z,qx,qy,qz,qw\n1583836591,182590976,1,2,3,0,0,0,1\n1583836591,282590976,2,2,3,0,0,0,1\n"
        )
        found = open_recording(root)
        assert found.layout == "newer-college"
        assert found[0].time is not None
        np.testing.assert_allclose(found.world_T_ego[0, :3, 3], [-0.084, -0.025, 0.05], atol=1e-9)
    with subtests.test("nuScenes"):
        root = tmp_path / "nuscenes"
        write_tables(root)
        tables = root / "v1.0-mini"
        rows = json.loads((tables / "sample_data.json").read_text())
        mounts = json.loads((tables / "calibrated_sensor.json").read_text())
        for k, row in enumerate(rows):
            channel = "LIDAR_TOP" if row["calibrated_sensor_token"] == "c-lidar" else "CAM_FRONT"
            kind = "samples" if row["is_key_frame"] else "sweeps"
            row |= {"filename": f"{kind}/{channel}/{k}.pcd.bin", "timestamp": 10**15 + 50_000 * k}
            if channel == "LIDAR_TOP":
                (root / row["filename"]).parent.mkdir(parents=True, exist_ok=True)
                five = np.column_stack([scans[0].points, np.zeros((len(scans[0]), 2))])
                five.astype("<f4").tofile(root / row["filename"])
        (tables / "sample_data.json").write_text(json.dumps(rows))
        mounts = [{**mount, "translation": [1, 0, 2], "rotation": [1, 0, 0, 0]} for mount in mounts]
        (tables / "calibrated_sensor.json").write_text(json.dumps(mounts))
        scene = next(row["name"] for row in json.loads((tables / "scene.json").read_text()) if row["nbr_samples"] == 3)
        found = open_recording(root, RecordingOptions(scene))
        assert found.layout == "nuscenes"
        assert len(found) == 6
        np.testing.assert_allclose(found.world_T_ego[:3, 0, 3], [0, 2, 5])
        np.testing.assert_allclose(found.ego_T_lidar[:3, 3], [1, 0, 2])
        np.testing.assert_allclose(found[1].points, scans[0].points, atol=1e-5)


def test_a_layout_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scans: list[Scan]) -> None:
    (tmp_path / "own_scans.py").write_text(
        "import numpy as np\n"
        "from data_tools.lidar import Scan\n"
        "from data_tools.recordings import ScanRecording\n"
        "def opened(source, options):\n"
        "    return ScanRecording('own', np.arange(3.0), lambda row: Scan.of(np.ones((5, 3))), str)\n"
        "def wrong(source, options):\n"
        "    return None\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert len(open_recording(tmp_path, RecordingOptions(most=2), "own_scans:opened")) == 2
    with pytest.raises(InputError, match="layout own_scans:wrong: expected a ScanRecording, got NoneType"):
        open_recording(tmp_path, layout="own_scans:wrong")
    with pytest.raises(InputError, match="unknown layout 'kitty'"):
        open_recording(tmp_path, layout="kitty")
    point = EntryPoint("ours", "own_scans:opened", GROUP)
    monkeypatch.setattr("saga_fg.parts.entry_points", lambda group: [point] if group == GROUP else [])
    offered.cache_clear()
    assert len(open_recording(tmp_path, layout="ours")) == 3
    offered.cache_clear()
    sys.modules.pop("own_scans")


def test_the_place_of_the_sensor_can_be_given(tmp_path: Path, scans: list[Scan]) -> None:
    place = yaw_transform(1.0, 0.0, 2.0, 0.1)
    found = open_recording(folder_of(tmp_path / "scans", scans), RecordingOptions(mount=place))
    np.testing.assert_array_equal(found.ego_T_lidar, place)
