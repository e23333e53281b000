"""Localisation in the map of an earlier drive: another lane, the other direction, a guess, and no place at all."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SENSOR_HEIGHT, SimulatedScans
from data_tools.lidar import Scan
from data_tools.pose_graphs import read_g2o
from data_tools.sensor_logs import SensorLog
from pipelines.slam.drive import SlamMap, read_map, write_map
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from pipelines.slam.localisation import Localiser, LocaliserSettings, localise
from pipelines.slam.results import write_lidar_slam, write_localised
from pipelines.slam.vehicle_sensors import Vehicle
from saga_fg import InputError
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.slam.pose_graph import optimise_poses
from saga_fg.slam.submaps import SubmapSettings
from saga_fg.types import GpsFix, WheelSpeed

PLAIN = LidarSlamSettings(landmarks=False, loop_closures=False, submaps=SubmapSettings(length=20.0))


def drive(start: float, y: float, count: int, back: bool = False) -> np.ndarray:
    """A drive along the street at 10 m/s."""
    travelled = start + (-1.0 if back else 1.0) * np.arange(count)
    return np.array([yaw_transform(x, y, SENSOR_HEIGHT, np.pi if back else 0.02 * np.sin(x / 5)) for x in travelled])


@pytest.fixture(scope="module")
def known() -> SlamMap:
    """The map of a drive, in the world of the street."""
    scans = SimulatedScans(3, world_T_lidar=drive(-10.0, -1.5, 60))
    found = lidar_slam(scans, settings=PLAIN)
    return SlamMap([submap.points for submap in found.submaps], found.world_T_submap)


def localised(known: SlamMap, poses: np.ndarray, guess: np.ndarray | None = None) -> tuple[Localiser, np.ndarray, int]:
    """The localiser, its errors (K,), m, over the whole path, and the number of scans registered."""
    scans, localiser, registered = SimulatedScans(3, world_T_lidar=poses), Localiser(known, guess), 0
    for k, time in enumerate(scans.timestamps.tolist()):
        registered += localiser.step(scans[k], time).registered
    path = localiser.path()
    assert path is not None
    return localiser, np.linalg.norm((inverse_transform(poses) @ path)[:, :3, 3], axis=1), registered


def test_a_second_drive_the_other_way_is_recognised_and_followed(known: SlamMap) -> None:
    _, errors, registered = localised(known, drive(45.0, 1.5, 34, back=True))
    assert errors.max() < 0.3
    assert np.median(errors) < 0.1
    assert registered > 10


def test_a_guess_takes_the_place_of_the_search(known: SlamMap, tmp_path: Path) -> None:
    write_map(tmp_path, known)
    again = read_map(tmp_path)
    np.testing.assert_allclose(again.map_T_submap, known.map_T_submap, atol=1e-8)
    np.testing.assert_array_equal(again.points[1], known.points[1])
    poses = drive(0.0, 0.5, 8)
    _, errors, registered = localised(again, poses, yaw_transform(0.8, 0.0, 1.6, 0.05))
    assert errors.max() < 0.2
    assert registered == 8


@pytest.mark.parametrize("ahead", [6.0, 500.0])
def test_a_wrong_guess_is_noticed_and_the_place_is_looked_for(
    known: SlamMap, caplog: pytest.LogCaptureFixture, ahead: float
) -> None:
    """Ground and parallel walls fit 6 m ahead as well, what stands there does not; 500 m ahead there is no map.

    Fixes are not blamed for the guess.
    """
    poses = drive(5.0, 0.5, 25)
    scans, guess = SimulatedScans(3, world_T_lidar=poses), poses[0] @ yaw_transform(ahead)
    fixes = poses[:, :3, 3] + np.random.default_rng(0).normal(0, 0.3, (25, 3))
    found = localise(scans, known, guess, log=SensorLog({"gps": np.column_stack([scans.timestamps, fixes])}))
    assert found.misfits == {}
    assert "fixes lie more than" not in caplog.text
    assert np.linalg.norm(found.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.3
    assert not found.registered[0]
    assert found.registered.sum() > 5


def test_a_wrong_guess_in_another_town_is_an_error(known: SlamMap) -> None:
    scans = SimulatedScans(8, world_T_lidar=drive(5.0, 0.5, 6))
    with pytest.raises(InputError, match="the scans do not fit it at the guess, and elsewhere none was found in 5 m"):
        localise(scans, known, yaw_transform(500.0))


def test_a_place_that_turns_out_wrong_is_given_up(known: SlamMap) -> None:
    """On the way the vehicle is carried 6 m ahead: the poses since the last comparison go, and it is found again."""
    poses = drive(-8.0, 0.5, 52)
    poses[12:, 0, 3] += 6.0
    scans, localiser = SimulatedScans(3, world_T_lidar=poses), Localiser(known, poses[0])
    lost = [localiser.step(scans[k], time).map_T_lidar is None for k, time in enumerate(scans.timestamps.tolist())]
    localiser.finish()
    path = localiser.path()
    assert path is not None
    errors = np.linalg.norm((inverse_transform(poses) @ path)[:, :3, 3], axis=1)
    assert errors[:10].max() < 0.3
    assert errors[-5:].max() < 0.3
    assert any(lost)
    assert not lost[-1]


def test_what_is_no_scan_is_refused_and_the_drive_goes_on(known: SlamMap) -> None:
    poses = drive(5.0, 0.5, 3)
    scans, localiser, nothing = SimulatedScans(3, world_T_lidar=poses), Localiser(known, poses[0]), np.empty((0, 3))
    for scan, time, message in (
        (None, 0.0, "scan: expected one in every step"),
        (scans[0].points, 0.0, "scan: expected"),
        (scans[0], float("nan"), "time: expected a finite number of seconds, got nan"),
        (scans[0], "0", "time: expected a finite number of seconds, got '0'"),
        (Scan.of(nothing), 0.0, "expected points to begin with, got none"),
    ):
        with pytest.raises(InputError, match=message):
            localiser.step(scan, time)  # type: ignore[arg-type]
    localiser.step(scans[0], 0.0)
    with pytest.raises(InputError, match=r"time: expected one after 0\.000000 s, got -1"):
        localiser.step(scans[1], -1.0)
    assert localiser.step(Scan.of(nothing), 0.1).map_T_lidar is not None
    assert localiser.step(scans[2], 0.2).registered
    localiser.finish()
    with pytest.raises(InputError, match="step: expected no scan after finish"):
        localiser.step(scans[2], 0.3)
    with pytest.raises(InputError, match="finish: expected to be called once"):
        localiser.finish()
    with pytest.raises(InputError, match="slam_map: expected"):
        Localiser("map")  # type: ignore[arg-type]


def test_outside_the_map_odometry_goes_on_and_back_in_it_the_place_is_found(known: SlamMap) -> None:
    """The map ends at x = 50 m, and scans fit 30 m further; the vehicle goes on to 105 m, and backs up."""
    poses = np.array([yaw_transform(35 + 70 * np.sin(np.pi * k / 104), 0.5, SENSOR_HEIGHT) for k in range(105)])
    scans = SimulatedScans(3, world_T_lidar=poses)
    localiser = Localiser(known, poses[0], LocaliserSettings(lost_after=20.0))
    steps = [localiser.step(scans[k], time) for k, time in enumerate(scans.timestamps.tolist())]
    localiser.finish()
    path = localiser.path()
    off = np.linalg.norm(path[:, :3, 3] - poses[:, :3, 3], axis=1)
    lost = [step.map_T_lidar is None for step in steps]
    assert lost[52]
    assert not lost[-1]
    assert off.max() < 1.0
    assert off[-10:].max() < 0.3


def test_of_two_like_streets_none_is_taken(known: SlamMap, subtests: pytest.Subtests) -> None:
    for turned in [False, True]:
        with subtests.test(turned=turned):
            further = known.map_T_submap.copy()
            further[:, 0, 3] += 300.0
            both = [known.map_T_submap, further]
            twice = SlamMap([*known.points, *known.points], np.concatenate(both[::-1] if turned else both))
            poses = drive(5.0, 0.5, 25)
            scans = SimulatedScans(3, world_T_lidar=poses)
            with pytest.raises(InputError, match="it is ambiguous: several places of the map look like it"):
                localise(scans, twice)
            if turned:
                continue
            fixes = poses[:, :3, 3] + np.random.default_rng(0).normal(0, 1.0, (25, 3))
            fixes[:2] += 1000.0  # elsewhere at first: the place is then looked for everywhere, and is ambiguous
            by_gps = localise(scans, twice, log=SensorLog({"gps": np.column_stack([scans.timestamps, fixes])}))
            assert np.linalg.norm(by_gps.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.4
            told = localise(scans, twice, poses[0])
            assert np.linalg.norm(told.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.3


def test_a_drive_shorter_than_the_search_is_looked_for_at_its_end(known: SlamMap) -> None:
    poses = drive(5.0, 0.5, 10)
    found = localise(SimulatedScans(3, world_T_lidar=poses), known)
    assert np.linalg.norm(found.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.3
    assert found.registered.any()


def test_wheels_and_imu_are_heard_in_a_map(known: SlamMap) -> None:
    poses = drive(5.0, 0.5, 20)
    scans, times = SimulatedScans(3, world_T_lidar=poses), 0.1 * np.arange(20)
    wheels = np.column_stack([times, np.full(20, 10.0)])
    imu = np.column_stack([times, np.tile([0, 0, 9.81, 0, 0, 0], (20, 1))])
    found = localise(scans, known, poses[0], log=SensorLog({"wheels": wheels, "imu": imu}))
    assert np.linalg.norm(found.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.3
    with pytest.raises(InputError, match="wheels: expected it among the sensors"):
        Localiser(known).step(scans[0], 0.0, wheels=WheelSpeed(9.0, 0.1))


@pytest.mark.parametrize("wrong", ["", "gps", "imu"])
def test_a_sensor_that_does_not_fit_is_named_in_a_map(
    known: SlamMap, tmp_path: Path, caplog: pytest.LogCaptureFixture, wrong: str
) -> None:
    """Fixes 200 m off, or samples without gravity: the path stays, and a warning names the sensor."""
    poses, rng = drive(5.0, 0.5, 30), np.random.default_rng(0)
    scans, times = SimulatedScans(3, world_T_lidar=poses), 0.1 * np.arange(30)
    fixes = poses[:, :3, 3] + rng.normal(0, 1.0, (30, 3)) + (200.0 if wrong == "gps" else 0.0)
    force = [0.0, 0.0, 0.0 if wrong == "imu" else 9.81, 0.0, 0.0, 0.0]
    log = SensorLog({"gps": np.column_stack([times, fixes]), "imu": np.column_stack([times, np.tile(force, (30, 1))])})
    found = localise(scans, known, poses[0], log=log)
    assert np.linalg.norm(found.trajectory.positions - poses[:, :3, 3], axis=1).max() < 0.3
    figures = write_localised(tmp_path / "run", found, scans, known)
    assert list(figures["misfits"]) == ([wrong] if wrong else [])
    assert figures["unjudged"] == {}
    assert all(text in caplog.text for text in found.misfits.values())
    assert ("fixes lie more than 9 deviations off" in caplog.text) == (wrong == "gps")


@pytest.mark.parametrize(
    ("travelled", "wait", "last"), [(8, 0.0, [True, False]), (50, 0.0, [False, False]), (8, 100.0, [False])]
)
def test_a_fix_counts_as_long_as_the_vehicle_is_near(
    known: SlamMap, travelled: int, wait: float, last: list[bool]
) -> None:
    """Places are looked for around a fix, then everywhere; an old fix is forgotten, by way or by time."""
    poses = drive(0.0, 0.5, travelled)
    scans, localiser, asked = (
        SimulatedScans(8, world_T_lidar=poses),
        Localiser(known, vehicle=Vehicle(sensors=["gps"])),
        [],
    )

    def recognised(query: np.ndarray, place: np.ndarray | None = None) -> None:
        asked.append(place is not None)

    localiser._map.recognised = recognised  # type: ignore[method-assign]
    for k in range(travelled):
        fix = GpsFix(np.array([500.0, 0.0, 0.0])) if k == 0 else None
        localiser.step(scans[k], 0.1 * k + (wait if k > 5 else 0.0), gps=fix)
    localiser.finish()
    assert asked[-2:] == last


def test_the_files_of_a_run_are_a_map_and_a_graph(tmp_path: Path) -> None:
    """What SLAM has written is read back: submaps, pose graph, landmarks; a second drive finds itself in it."""
    scans = SimulatedScans(3, world_T_lidar=drive(0.0, -1.5, 40))
    result = lidar_slam(scans, settings=LidarSlamSettings(submaps=SubmapSettings(length=20.0)))
    write_lidar_slam(tmp_path / "first", result, scans, settings=LidarSlamSettings())
    assert len(list((tmp_path / "first" / "map").glob("*.ply"))) == len(result.submaps)
    graph = read_g2o(tmp_path / "first" / "graph.g2o")
    assert len(graph) == len(result.keyframes)
    np.testing.assert_allclose(graph.world_T_pose, result.world_T_lidar, atol=1e-9)
    settled = result.world_T_lidar[0] @ inverse_transform(graph.world_T_pose[0]) @ optimise_poses(graph).world_T_pose
    assert np.linalg.norm(settled[-1, :3, 3] - result.world_T_lidar[-1, :3, 3]) < 0.5
    seen = (tmp_path / "first" / "observations.csv").read_text().splitlines()[1:]
    assert len(seen) == sum(mark.observations for mark in result.landmarks)
    header, *rows = (tmp_path / "first" / "landmarks.csv").read_text().splitlines()
    assert header == "number,kind,observations,deviations,geometry"
    assert len(rows) == len(result.landmarks)
    assert any(",wall," in row and '"MULTILINESTRING ((' in row for row in rows)
    assert any(",pole," in row and '"POINT (' in row for row in rows)
    second = SimulatedScans(3, world_T_lidar=drive(10.0, 0.5, 26))
    slam_map = read_map(tmp_path / "first")
    found = localise(second, slam_map)
    shutil.copytree(tmp_path / "first", tmp_path / "second")
    (tmp_path / "second" / "notes.txt").write_text("mine")
    figures = write_localised(tmp_path / "second", found, second, slam_map)
    of_second = ["above.png", "covariances.csv", "metrics.json", "notes.txt", "reference.tum", "times.txt"]
    of_second += ["trajectory.tum", "trajectory.txt"]  # nothing of the first run is left
    assert sorted(file.name for file in (tmp_path / "second").iterdir()) == of_second
    assert figures["trajectory"]["ate"] < 0.2
    assert figures["registered"] > 5
    header, *rows = (tmp_path / "second" / "covariances.csv").read_text().splitlines()
    assert header.startswith("timestamp,registered,P11,P12")
    assert [row.split(",")[1] for row in rows] == [str(int(one)) for one in found.registered]
    errors = np.linalg.norm(found.trajectory.positions - second.world_T_ego[:, :3, 3], axis=1)
    sigma = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert (errors < 5 * sigma).all()
    assert np.linalg.eigvalsh(found.covariances).min() > 0
    assert (tmp_path / "second" / "trajectory.tum").is_file()
    with pytest.raises(InputError, match="expected one that shows a place of this drive"):
        localise(SimulatedScans(8, world_T_lidar=drive(0.0, 0.0, 4)), slam_map)


def test_maps_and_guesses_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a map: a folder with submaps\.csv"):
        read_map(tmp_path)
    (tmp_path / "submaps.csv").write_text("number,file,x,y,z,qx,qy,qz,qw\n0,../a.ply,0,0,0,0,0,0,1\n")
    with pytest.raises(InputError, match=r"line 2: file: expected a file beside submaps\.csv"):
        read_map(tmp_path)
    (tmp_path / "submaps.csv").write_text("number,file,x,y,z,qx,qy,qz,qw\n0,a.ply,0,0,0,0,0,0,2\n")
    with pytest.raises(InputError, match="line 2: qx qy qz qw: expected a unit quaternion"):
        read_map(tmp_path)
    (tmp_path / "origin.csv").write_text("latitude [deg],longitude [deg],altitude [m]\n91,8,100\n")
    (tmp_path / "submaps.csv").write_text("number,file,x,y,z,qx,qy,qz,qw\n")
    with pytest.raises(InputError, match=r"line 2: latitude \[deg\]: expected a number within 85, got 91"):
        read_map(tmp_path)
    with pytest.raises(InputError, match="expected points in at least one submap"):
        SlamMap([np.empty((0, 3), dtype=np.float32)], np.eye(4)[None])
