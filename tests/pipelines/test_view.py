"""The view in space: what is in the file, read back by rerun's own reader."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.nuscenes import NuScenes, nuscenes_scans
from data_tools.lidar import write_cloud
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from data_tools.trajectories import Trajectory, write_tum_poses
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.report import scene_of_run
from pipelines.tracking import track_scene
from pipelines.view import SceneView, draw_scene, read_slam_view, write_view
from pipelines.view.scenes import HELD, ellipses
from saga_fg import InputError
from saga_fg.tracking import Journal
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, tables, write_tables

Rows = dict[str, dict[Any, Any]]
"""Column -> time (None: always) -> value."""


def read_back(path: Path) -> dict[str, Rows]:
    """Entity -> its rows."""
    reader = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed (extra [view])")
    found: dict[str, Rows] = {}
    for chunk in reader.RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        time = columns.get("time")
        for name, column in columns.items():
            if name in chunk.timeline_names:
                continue
            rows = found.setdefault(chunk.entity_path, {}).setdefault(name, {})
            for k in range(batch.num_rows):
                if column[k].is_valid:
                    rows[None if time is None else time[k].value / 1e9] = column[k].as_py()
    return found


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["view", *map(str, arguments)])


def test_tracks_truth_and_edges_are_in_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra [view])")
    config = load_config("simulated")
    scene = SimulatedTraffic(SimulatorSettings(duration=2.0, warm_up=5.0), scenes=1, seed=1).scene("scene-0001")
    events: list[dict[str, Any]] = []
    done = track_scene(scene, config.new_tracker("saga", Journal(config.tracker, events.append)))
    shown = scene_of_run({"saga": done}, config.tracker.edges, config.sensors)
    graphs = [event for event in events if event["event"] == "graph"]
    write_view(tmp_path / "a.rrd", "a", ["scene-0001"], draw_scene(SceneView(shown, graphs=graphs)))
    found = read_back(tmp_path / "a.rrd")
    origin, k = scene.world_T_ego[0, :3, 3], 12
    time = round(float(scene.timestamps[k] - scene.timestamps[0]), 9)
    tracks = done.tracks[k]

    def at(entity: str, column: str) -> Any:
        times = {round(at, 9): value for at, value in found[f"/scene-0001/{entity}"][column].items()}
        return times[time]

    assert len(tracks) > 5
    np.testing.assert_allclose(at("saga/boxes", "Boxes3D:centers"), tracks.boxes.position - origin, atol=1e-3)
    np.testing.assert_allclose(at("saga/boxes", "Boxes3D:half_sizes"), tracks.boxes.size / 2, atol=1e-3)
    labels = at("saga/boxes", "Boxes3D:labels")
    assert [label.split()[:2] for label in labels] == [
        [str(id_), label] for id_, label in zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
    ]
    assert len(at("saga/ellipses", "Ellipsoids3D:half_sizes")) == len(tracks)
    paths = at("saga/trajectories", "LineStrips3D:strips")
    np.testing.assert_allclose([path[-1] for path in paths], tracks.boxes.position - origin, atol=1e-3)
    assert max(map(len, paths)) == k + 1
    strips = np.array(at("saga/edges", "LineStrips3D:strips"))
    assert strips.shape[1:] == (2, 3)  # from the place of one track to that of another
    places = tracks.boxes.position - origin
    assert (np.abs(strips[:, :, None] - places).max(axis=3).min(axis=2) < 1e-3).all()
    assert scene.ground_truth is not None
    seen = len(at("truth/seen", "Boxes3D:centers"))
    assert seen == scene.ground_truth[k].visible.sum()
    assert seen + len(at("truth/hidden", "Boxes3D:centers")) == len(scene.ground_truth[k])
    graph = [each for each in graphs if abs(each["time"] - scene.timestamps[k]) < 1e-4][-1]
    assert at("graph/nodes", "Points3D:labels") == [node["name"] for node in graph["nodes"]]
    np.testing.assert_allclose(
        np.array(at("graph/nodes", "Points3D:positions"))[:, :2],
        np.array([node["position"] for node in graph["nodes"]]) - origin[:2],
        atol=2e-3,
    )
    detections = [factor for factor in graph["factors"] if factor["kind"] == "detection"]
    assert len(at("graph/detection", "LineStrips3D:strips")) == len(detections) > 0
    assert len(at("graph/interaction", "LineStrips3D:strips")) == 2 * sum(
        factor["kind"] == "interaction" for factor in graph["factors"]
    )
    np.testing.assert_allclose(at("ego", "Transform3D:translation")[0], scene.world_T_ego[k, :3, 3] - origin, atol=1e-3)


def test_the_ellipse_holds_ninety_percent() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    size, (angle,) = ellipses(covariance[None])
    half = size[:, :2] / 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(turn @ np.diag(half[0] ** 2) @ turn.T, HELD * covariance)
    points = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 20000) @ turn / half[0]
    assert np.mean(np.sum(points**2, axis=1) < 1) == pytest.approx(0.9, abs=0.01)


def test_kitti_with_scans_and_a_map(tmp_path: Path) -> None:
    root = write_sequence(tmp_path / "kitti")
    (root / "result").mkdir()
    (root / "result" / "0007.txt").write_text("1 4 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.5707963 0.9\n")
    (root / "training" / "velodyne" / "0007").mkdir(parents=True)
    np.array([[5, 1, 0, 0.5], [5.001, 1, 0, 0.5], [6, 2, 0, 0.1]], dtype="<f4").tofile(
        root / "training" / "velodyne" / "0007" / "000001.bin"
    )
    slam = tmp_path / "slam"
    slam.mkdir()
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    write_tum_poses(slam / "trajectory.tum", Trajectory(np.array([0.0, 0.1]), poses))
    write_cloud(slam / "landmarks.ply", np.array([[3.0, 4.0, 0.5]]))
    marks = [{"number": 2, "kind": "pole", "x": 3.0, "y": 4.0}, {"number": 3, "kind": "wall", "x": 0.0, "nx": 1.0}]
    (slam / "landmarks.json").write_text(json.dumps(marks))
    file = tmp_path / "k.rrd"
    result = run("kitti", root / "result", "--dataroot", root, "--detections", root / "found", "--slam", slam,
                 "--save", file)  # fmt: skip
    if "rerun-sdk" not in result.stderr and "pip install" in result.stderr:
        pytest.skip("rerun-sdk is not installed (extra [view])")
    assert result.exit_code == 0, result.output
    found = read_back(file)
    (points,) = found["/0007/ego/lidar/points"]["Points3D:positions"].values()
    np.testing.assert_allclose(points, [[5, 1, 0], [6, 2, 0]])  # thinned, in the sensor's frame
    (place,) = found["/0007/ego/lidar"]["Transform3D:translation"].values()
    np.testing.assert_allclose(place, [[1, 0, 2]])
    assert list(found["/0007/ego/lidar/points"]["Points3D:positions"]) == [pytest.approx(0.1)]
    (centre,) = (row for row in found["/0007/tracks/boxes"]["Boxes3D:centers"].values() if row)
    np.testing.assert_allclose(centre, [[12, -2, 1]], atol=1e-3)
    assert found["/0007/slam/names"]["Points3D:labels"] == {None: ["pole 2"]}
    np.testing.assert_allclose(found["/0007/slam/names"]["Points3D:positions"][None], [[3, 4, 0]])
    alone = tmp_path / "s.rrd"
    assert run("slam", slam, "--save", alone).exit_code == 0
    assert "/slam/trajectory" in read_back(alone)


def test_scans_of_nuscenes_are_found_where_their_files_are(tmp_path: Path) -> None:
    content = tables()
    for row in content["calibrated_sensor"]:
        row |= {"translation": [0.9, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}
    for row in content["sample_data"]:
        row["filename"] = f"samples/LIDAR_TOP/{row['sample_token']}.pcd.bin"
    root = write_tables(tmp_path, content)
    (root / "samples" / "LIDAR_TOP").mkdir(parents=True)
    np.array([[1, 2, 3, 0.5, 7]], dtype="<f4").tofile(root / "samples" / "LIDAR_TOP" / "a1.pcd.bin")
    (name, scans), = nuscenes_scans(NuScenes(root, VERSION, {}), root).items()  # fmt: skip
    assert (name, len(scans)) == ("scene-0103", 1)
    assert scans[0].points.tolist() == [[1, 2, 3]]
    assert scans.world_T_ego[0, :3, 3].tolist() == [5, 0, 0]
    assert scans.ego_T_lidar[:3, 3].tolist() == [0.9, 0, 1.8]
    content["sample_data"][0]["filename"] = "../../etc/passwd"
    with pytest.raises(InputError, match="expected a file below the dataroot"):
        nuscenes_scans(NuScenes(write_tables(tmp_path, content), VERSION, {}), root)


def test_broken_slam_results_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"trajectory\.tum"):
        read_slam_view(tmp_path)
    write_tum_poses(tmp_path / "trajectory.tum", Trajectory(np.array([0.0]), np.eye(4)[None]))
    (tmp_path / "landmarks.json").write_text('[{"kind": "pole"}]')
    with pytest.raises(InputError, match="expected a list of landmarks"):
        read_slam_view(tmp_path)


def test_without_rerun_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = run("file", tmp_path / "t.csv", "--save", tmp_path / "t.rrd")
    assert result.exit_code == 2
    assert 'pip install "saga-fg[view]"' in result.stderr


def test_a_file_that_cannot_be_written_to_its_end_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra [view])")

    def full(stream: Any) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rerun.RecordingStream, "flush", full)
    with pytest.raises(InputError, match=r"a\.rrd: not written, is the disk full\? File-writer thread"):
        write_view(tmp_path / "a.rrd", "a", ["world"], [])
    assert not list(tmp_path.iterdir())


def test_a_view_takes_the_place_of_no_file_of_a_result(tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_text("points")
    done = run("slam", tmp_path, "--save", tmp_path / "map.ply")
    assert done.exit_code == 2
    assert "map.ply: expected a file name that ends in .rrd (rerun) or .mcap (Foxglove)" in done.stderr
    assert (tmp_path / "map.ply").read_text() == "points"
