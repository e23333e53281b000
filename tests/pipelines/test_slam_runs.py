"""Runs of SLAM: watched, as a page, and several in one map."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scans import SENSOR_HEIGHT, SimulatedScans, write_recording
from data_tools.trajectories import read_tum_poses
from pipelines.slam.drive import read_map
from pipelines.slam.lidar_slam import LidarSlamSettings, lidar_slam
from pipelines.slam.merging import merge_sessions, read_session
from pipelines.slam.results import write_lidar_slam
from pipelines.view import Drawing, draw_slam_step
from pipelines.view.scenes import Pose
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
    for name in ("cut", "short", "unordered"):
        shutil.copytree(runs / "back", tmp_path / name)
    (tmp_path / "cut" / "graph.g2o").unlink()
    table = tmp_path / "short" / "covariances.csv"
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([head, *rows[:-1]]) + "\n")
    (tmp_path / "unordered" / "covariances.csv").write_text("\n".join([head, *reversed(rows)]) + "\n")
    there, output = runs / "there", tmp_path / "both"
    for given, message in [
        ([there], "RUN: expected two folders or more of different names, got there"),
        ([there, there], "got there, there"),
        ([there, runs / "back", "--output", runs], "expected another folder than the runs' and those that they are in"),
        ([there, tmp_path / "none"], "none: expected graph.g2o, as"),
        ([there, tmp_path / "cut"], "graph.g2o"),
        ([there, tmp_path / "unordered"], "covariances.csv: timestamp: expected increasing times"),
        ([there, tmp_path / "short"], "expected as many rows of covariances.csv as poses of graph.g2o"),
    ]:
        with subtests.test(message):
            shown = refused("slam", "merge", *([] if "--output" in given else ["--output", output]), *given)
            assert message in " ".join(shown.split())
            assert not output.exists()


def test_a_page_shows_drift_errors_and_open_motions(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "there", tmp_path / "drive")
    figures = json.loads((tmp_path / "drive" / "metrics.json").read_text())
    figures["degenerate"] = [{"first": 4, "last": 9, "from": 0.4, "until": 0.9, "motions": ["along the road"]}]
    figures["odometry"]["ate"] = 0.0
    (tmp_path / "drive" / "metrics.json").write_text(json.dumps(figures))
    done("report", "slam", tmp_path / "drive", "--output", tmp_path / "drive.html")
    page = (tmp_path / "drive.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "<td>4 to 9</td><td>0.5</td><td>along the road</td>" in page
    assert f"<td>trajectory</td><td>{figures['trajectory']['ate']:.3f}</td>" in page
    assert "<td>odometry</td><td>0.000</td>" in page
    without = {name: value for name, value in figures.items() if name != "false_loops"}
    for broken in (without, figures | {"online": figures["online"] | {"ate": "none"}}):
        (tmp_path / "drive" / "metrics.json").write_text(json.dumps(broken))
        shown = refused("report", "slam", tmp_path / "drive", "--output", tmp_path / "none.html")
        assert "metrics.json: expected the figures of a run" in shown
    assert "expected" in refused("report", "slam", tmp_path, "--output", tmp_path / "none.html")
    assert not (tmp_path / "none.html").exists()


def test_a_run_is_drawn_while_it_goes_on() -> None:
    scans, drawn = SimulatedScans(3, world_T_lidar=along(-10.0, 20.0, -1.5, 0.0)), list[Drawing]()
    result = lidar_slam(scans, settings=PLAIN, watch=lambda *step: drawn.extend(draw_slam_step(*step)))
    poses = [one for one in drawn if one.path == "slam/pose"]
    assert [one.time for one in poses] == pytest.approx(scans.timestamps)
    assert all(isinstance(one.shape, Pose) for one in poses)
    np.testing.assert_allclose(poses[-1].shape.parent_T_child[:3, 3], result.online.positions[-1], atol=1e-9)
    closed = {one.path for one in drawn if one.path.endswith("/points")}
    assert closed == {f"slam/submap {number}/points" for number in range(len(result.submaps) - 1)}  # but the last
    placed = [one for one in drawn if one.path == "slam/submap 0"]
    np.testing.assert_allclose(placed[-1].shape.parent_T_child, result.world_T_submap[0], atol=0.05)


def test_the_viewer_gets_each_scan_as_it_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = pytest.importorskip("rerun")
    saved = tmp_path / "live.rrd"
    monkeypatch.setattr(rerun.RecordingStream, "spawn", lambda stream, **_: stream.save(str(saved)))
    write_recording(SimulatedScans(3, world_T_lidar=along(-10.0, 0.0, -1.5, 0.0)), tmp_path / "scans")
    done("slam", "scans", tmp_path / "scans", "--view", "--output", tmp_path / "out")
    assert saved.stat().st_size > 10_000
