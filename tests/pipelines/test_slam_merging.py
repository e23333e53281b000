"""Several drives in one map: places in common, the merged paths, and folders that cannot be merged."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SENSOR_HEIGHT, SimulatedScans
from data_tools.trajectories import read_tum_poses
from pipelines.slam.drive import read_map
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from pipelines.slam.merging import merge_sessions, read_session
from pipelines.slam.results import write_lidar_slam
from saga_fg import InputError
from saga_fg.numerics import inverse_transform, yaw_transform
from saga_fg.slam.submaps import SubmapSettings
from tests.pipelines.command import done, refused

PLAIN = LidarSlamSettings(landmarks=False, loop_closures=False, submaps=SubmapSettings(length=20.0))


def along(start: float, stop: float, y: float, yaw: float) -> np.ndarray:
    """A drive along the street, a scan each metre."""
    way = np.arange(start, stop, 1.0 if stop > start else -1.0)
    return np.array([yaw_transform(x, y, SENSOR_HEIGHT, yaw) for x in way])


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of two drives along one street, there and back, each in a world of its own, and of one in another."""
    folder = tmp_path_factory.mktemp("runs")
    for name, street, poses in (
        ("there", 3, along(-10.0, 50.0, -1.5, 0.0)),
        ("back", 3, along(70.0, 5.0, 1.5, np.pi)),
        ("elsewhere", 8, along(-10.0, 40.0, -1.5, 0.0)),
    ):
        scans = SimulatedScans(street, world_T_lidar=poses)
        scans.world_T_ego = inverse_transform(poses[0]) @ poses
        write_lidar_slam(folder / name, lidar_slam(scans, settings=PLAIN), scans, PLAIN)
    return folder


def test_a_drive_back_lies_where_it_was_in_the_world_of_the_first(runs: Path, tmp_path: Path) -> None:
    shown = done("slam", "merge", runs / "there", runs / "back", "--output", tmp_path / "both")
    assert "2 drives" in shown.stdout
    for name, first in (("there", (-10.0, -1.5, 0.0)), ("back", (70.0, 1.5, np.pi))):
        merged = read_tum_poses(tmp_path / "both" / "paths" / f"{name}.tum")
        own = read_tum_poses(runs / name / "reference.tum").world_T_ego
        true = yaw_transform(10.0, 1.5) @ yaw_transform(*first[:2], 0.0, first[2]) @ own
        assert np.linalg.norm(merged.positions - true[:, :3, 3], axis=1).max() < 0.3, name
    both, parts = read_map(tmp_path / "both"), [read_map(runs / name) for name in ("there", "back")]
    assert len(both.points) == sum(len(one.points) for one in parts)


def test_the_first_drive_bends_no_more_than_loops_demand(runs: Path) -> None:
    there, back = (read_session(runs / name) for name in ("there", "back"))
    merged = merge_sessions([there, back])
    assert len(merged.loops) >= 2
    assert not merged.false_loops
    assert len(merged.graph) == len(there.graph) + len(back.graph)
    assert np.abs(merged.sessions[0].path.positions - there.path.positions).max() < 0.2


def test_drives_without_places_in_common_are_refused(runs: Path) -> None:
    sessions = [read_session(runs / name) for name in ("there", "elsewhere")]
    with pytest.raises(InputError, match=r"elsewhere: expected places in common with there: [01] of"):
        merge_sessions(sessions)


def test_folders_that_are_no_runs_are_one_line(runs: Path, tmp_path: Path, subtests) -> None:
    for name in ("cut", "short"):
        shutil.copytree(runs / "back", tmp_path / name)
    (tmp_path / "cut" / "graph.g2o").unlink()
    table = tmp_path / "short" / "covariances.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:-1]) + "\n")
    there, output = runs / "there", tmp_path / "both"
    for given, message in [
        ([there], "RUN: expected two folders or more of different names, got there"),
        ([there, there], "got there, there"),
        ([there, tmp_path / "none"], "expected a map"),
        ([there, tmp_path / "cut"], "graph.g2o"),
        ([there, tmp_path / "short"], "expected as many rows of covariances.csv as poses of graph.g2o"),
    ]:
        with subtests.test(message):
            shown = refused("slam", "merge", *given, "--output", output)
            assert message in " ".join(shown.split())
            assert not output.exists()
