"""LiDAR SLAM with the vehicle's sensors: through a tunnel, over a field, and KITTI's records by the command."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.inertial import DRIVES, SETTINGS, end_nees, inertial_drive
from benchmarks.scans import SENSOR_HEIGHT, ScannerSettings, SimulatedScans, StaticWorld, drive
from data_tools.lidar import Scan
from data_tools.recordings import ScanRecording
from data_tools.sensor_logs import SensorLog, kitti_sensor_log, plausible_inertial
from pipelines.slam.configuration import sensor_log
from pipelines.slam.lidar_slam import LidarSlam, LidarSlamSettings, lidar_slam
from pipelines.slam.results import degenerate_spans, metrics
from pipelines.slam.vehicle_sensors import Vehicle
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.frame import WheelSpeed
from tests.data_tools.featureless import open_field, tunnel
from tests.pipelines.command import done

PERIOD = 0.1
TIMES = PERIOD * np.arange(10)
PLAIN = LidarSlamSettings(landmarks=False, loop_closures=False)
NOTHING = Scan.of(np.empty((0, 3)))
RECORDING = ScanRecording("folder", TIMES, lambda row: NOTHING, str)


def braking_drive(world: StaticWorld, count: int = 34) -> tuple[SimulatedScans, np.ndarray]:
    """A straight drive that brakes from 12 to 6 m/s, as odometry by constant velocity does not expect; its speeds."""
    speed = np.clip(12.0 - 0.4 * (np.arange(count) - 14), 6.0, 12.0)
    x = np.concatenate([[0.0], np.cumsum(speed[1:] * PERIOD)])
    poses = np.array([yaw_transform(-5.0 + at, -1.5, SENSOR_HEIGHT, 0.0) for at in x])
    settings = ScannerSettings(rings=24, columns=360, reach=25.0)
    return SimulatedScans(0, world_T_lidar=poses, settings=settings, world=world), speed


def test_in_a_tunnel_the_wheels_say_how_far() -> None:
    scans, speed = braking_drive(tunnel(5.0, 300.0, seed=0))
    rng, times = np.random.default_rng(0), PERIOD * np.arange(len(speed))
    wheels = np.column_stack([times, speed + rng.normal(0, 0.05, len(speed))])
    alone, helped = (lidar_slam(scans, settings=PLAIN, log=log) for log in (None, SensorLog({"wheels": wheels})))
    ends = [np.linalg.norm(one.trajectory.positions[-1] - scans.world_T_ego[-1, :3, 3]) for one in (alone, helped)]
    assert ends[1] < 0.5 < 2.0 < ends[0]
    figures = metrics(helped, scans)
    assert figures["misfits"] == figures["unjudged"] == {}
    last = figures["degenerate"][-1]
    assert "along the road" in last["motions"]
    assert last["last"] == len(speed) - 1
    assert alone.covariances[-1, 3, 3] > 1.0
    assert helped.covariances[-1, 3, 3] < 0.1


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.1, r"1\.\d+ times that by the scans, where .* allow \d\.\d% off; it is multiplied by 0\.9\d+ from here on"),
        (-1.0, "they are left out"),
    ],
)
def test_wheels_of_another_scale_are_named_at_once_and_corrected(
    factor: float, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    scans = SimulatedScans(0, world_T_lidar=drive(60, speed=8.0))
    slam = LidarSlam(scans.world_T_ego[0], PLAIN, vehicle=Vehicle(sensors=["wheels"]))
    rng, named = np.random.default_rng(0), []
    for k, time in enumerate(scans.timestamps.tolist()):
        speed = factor * 8.0 + float(rng.normal(0, 0.05))
        slam.step(scans[k], time, wheels=WheelSpeed(speed, PERIOD if k else 0.0))
        named += [k] if re.search(said, caplog.text) else []
    assert 15 < named[0] < 30
    result = slam.finish()
    assert re.search(said, result.misfits["wheels"])
    assert len(re.findall(said, caplog.text)) == 1
    off = np.linalg.norm(result.trajectory.positions - scans.world_T_ego[:, :3, 3], axis=1)
    assert off.max() < 0.2


def test_over_a_field_gps_and_wheels_carry_the_pose(caplog: pytest.LogCaptureFixture) -> None:
    scans, speed = braking_drive(open_field())
    rng, times = np.random.default_rng(1), PERIOD * np.arange(len(speed))
    fixes = scans.world_T_ego[:, :3, 3] + rng.normal(0, 0.5, (len(speed), 3))
    fixes[20] += [1000.0, 0.0, 0.0]  # a jump
    log = SensorLog({"gps": np.column_stack([times, fixes]), "wheels": np.column_stack([times, speed])})
    found = lidar_slam(scans, settings=PLAIN, log=log)
    assert np.linalg.norm(found.trajectory.positions - scans.world_T_ego[:, :3, 3], axis=1).max() < 1.0
    assert re.search(r"gps: 1 of \d+ fixes lie more than 9 deviations off, and hardly count", caplog.text)
    assert all("across the road" in motions for motions in found.degenerate[1:])
    assert found.misfits == {}


def test_an_imu_predicts_and_straightens_scans_in_fast_turns() -> None:
    drive = inertial_drive(DRIVES["turns"], 1)
    ends = {}
    for name, log in (("without", None), ("with", SensorLog({"imu": drive.imu}))):
        found = lidar_slam(drive, settings=SETTINGS, log=log)
        ends[name] = np.linalg.norm(found.trajectory.positions[-1] - drive.world_T_ego[-1, :3, 3])
    assert ends["with"] < 0.3 < 3.0 < ends["without"]
    assert end_nees(found, drive) < 4.0


def test_a_sensor_that_was_carried_is_found_again(caplog: pytest.LogCaptureFixture) -> None:
    drive = inertial_drive(DRIVES["carried"], 1, carried_at=66.0)
    found = lidar_slam(drive, settings=SETTINGS)
    assert len(re.findall(r"it fits the map \d+\.\d m from where it was expected: moved", caplog.text)) == 1
    assert np.linalg.norm(found.trajectory.positions - drive.world_T_ego[:, :3, 3], axis=1).max() < 0.5


def test_spans_of_scans_that_leave_the_same_motions_open() -> None:
    road, none = ("along the road",), ()
    spans = degenerate_spans(np.arange(6.0), [none, road, road, none, road, ("heading",)])
    assert [(one["first"], one["last"], one["until"]) for one in spans] == [(1, 2, 2.0), (4, 4, 4.0), (5, 5, 5.0)]


def test_the_command_takes_records_and_tables(recordings: Path, tmp_path: Path) -> None:
    table = tmp_path / "wheels.csv"
    table.write_text("time [s],speed [km/h]\n" + "".join(f"{0.1 * k:.1f},12.6\n" for k in range(1, 12)))
    options = [str(recordings / "kitti"), "--scans", "8", "--no-landmarks", "--sensors", "gps,imu"]
    command = ["slam", "scans", *options, "--sensor-log", f"wheels={table}", "--output", str(tmp_path / "run")]
    said = done(*command).stdout
    assert "trajectory against the recording: ATE" in said
    assert "odometry against the recording: ATE" in said
    assert "no RPE on a path shorter than 10 m" in said
    assert "nan" not in said
    figures = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert figures["degenerate"] == []
    assert figures["trajectory"]["ate"] < 0.5
    assert figures["misfits"] == {}
    assert set(figures["unjudged"]) == {"gps", "imu", "wheels"}
    assert re.fullmatch(
        r"gps: factors in the graph: \d, too few to judge whether it fits; 15 are needed", figures["unjudged"]["gps"]
    )
    assert figures["unjudged"]["wheels"].startswith("wheels: not used so far")


def test_sensors_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--sensors: expected some of gps, imu, wheels, got 'radar'"):
        sensor_log(RECORDING, "radar", [])
    with pytest.raises(InputError, match="--sensor-log: expected some of gps, imu, wheels, got 'radar'"):
        sensor_log(RECORDING, "", ["radar=radar.csv"])
    with pytest.raises(InputError, match="imu: expected either --sensors or --sensor-log, once"):
        sensor_log(RECORDING, "imu", ["imu=imu.csv"])
    with pytest.raises(InputError, match=r"--sensor-log: expected SENSOR=FILE, such as imu=imu.csv, got 'imu'"):
        sensor_log(RECORDING, "", ["imu"])
    with pytest.raises(InputError, match="--sensors gps: expected a sensor of the recording, it has none"):
        sensor_log(RECORDING, "gps", [])
    assert sensor_log(RECORDING, "", []) is None


def test_a_log_of_another_time_is_refused(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for rows, got in [
        ("", "no rows"),
        ("1317617735.0,1\n1317617736.0,1\n", r"rows from 1317617735\.000 to 1317617736"),
    ]:
        with subtests.test(got):
            table = tmp_path / "wheels.csv"
            table.write_text(f"time [s],speed [m/s]\n{rows}")
            with pytest.raises(
                InputError, match=rf"wheels\.csv: time: expected rows .* from 0\.000 to 0\.900 s, got {got}"
            ):
                sensor_log(RECORDING, "", [f"wheels={table}"])


def test_fixes_are_placed_where_the_recording_begins(tmp_path: Path) -> None:
    """Not where the log begins."""
    records, table = tmp_path / "0000.txt", tmp_path / "gps.csv"
    records.write_text(11 * (" ".join(["49.0", "8.4", "100.0", *["0"] * 27]) + "\n"))
    recording = replace(
        RECORDING, origin=(49.0, 8.4, 100.0), sensors=lambda: kitti_sensor_log(records, ("gps",), 0).tables
    )
    table.write_text("time [s],latitude [deg],longitude [deg],altitude [m]\n0.5,49.0001,8.4,103\n0.6,49.0002,8.4,103\n")
    log = sensor_log(recording, "", [f"gps={table}"])
    np.testing.assert_allclose(log.tables["gps"][:, 1:], [[0, 11.132, 3], [0, 22.264, 3]], rtol=1e-3, atol=1e-6)
    of_map = (49.001, 8.4, 90.0)  # 111 m north of the records, 10 m below
    log = sensor_log(recording, "", [f"gps={table}"], None, lambda: of_map)
    np.testing.assert_allclose(log.tables["gps"][:, 1:], [[0, -100.19, 13], [0, -89.06, 13]], rtol=1e-3, atol=1e-6)
    from_records = sensor_log(recording, "gps", [], None, lambda: of_map)
    np.testing.assert_allclose(from_records.tables["gps"][:, 1:].mean(axis=0), [0, -111.32, 10], atol=2.0)


@pytest.mark.parametrize(("force", "turn", "said"), [(1.0, 0.1, "taken for g"), (9.8, 40.0, "taken for deg/s")])
def test_inertial_samples_in_g_or_degrees_are_converted_and_named(
    force: float, turn: float, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    table = np.column_stack([TIMES, np.zeros((10, 2)), np.full(10, force), np.zeros((10, 2)), np.full(10, turn)])
    found = plausible_inertial(table)
    assert said in caplog.text
    np.testing.assert_allclose(found[:, 3], 9.8, atol=0.01)
    np.testing.assert_allclose(found[:, 6], turn if turn < 1 else np.deg2rad(turn))
    caplog.clear()
    np.testing.assert_array_equal(plausible_inertial(found), found)
    assert not caplog.text
