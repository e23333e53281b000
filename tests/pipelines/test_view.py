"""Results in space, and as files for Foxglove."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.nuscenes import nuscenes_scans
from data_tools.figures import class_colours
from data_tools.lidar import Scan
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from data_tools.trajectories import Trajectory, write_tum_poses
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.report import ReportScene, scene_of_run
from pipelines.tracking import track_scene
from pipelines.view import SceneView, draw_scene, read_slam_view, write_view
from pipelines.view.scenes import HELD, ellipses
from saga_fg import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tracking import Journal
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, tables, write_tables
from tests.pipelines.command import done, refused

Rows = dict[str, dict[Any, Any]]
"""Column -> time (None: always) -> value."""


def read_rrd(path: Path) -> dict[str, Rows]:
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


def test_sizes_labels_edges_and_the_graph_are_in_the_file(tmp_path):
    """All places are those of the file for Foxglove, which is compared with the result below."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra [view])")
    config = load_config("simulated")
    scene = SimulatedTraffic(SimulatorSettings(duration=2.0, warm_up=5.0), scenes=1, seed=1).scene("scene-0001")
    events: list[dict[str, Any]] = []
    done = track_scene(scene, config.new_tracker("saga", Journal(config.tracker, events.append)))
    shown = scene_of_run({"saga": done}, config.tracker.edges, config.sensors)
    graphs = [event for event in events if event["event"] == "graph"]
    write_view(tmp_path / "a.rrd", "a", ["scene-0001"], draw_scene(SceneView(shown, graphs=graphs)))
    found = read_rrd(tmp_path / "a.rrd")
    origin, k = scene.world_T_ego[0, :3, 3], 12
    time = round(float(scene.timestamps[k] - scene.timestamps[0]), 9)
    tracks = done.tracks[k]

    def at(entity: str, column: str) -> Any:
        times = {round(at, 9): value for at, value in found[f"/scene-0001/{entity}"][column].items()}
        return times[time]

    assert len(tracks) > 5
    np.testing.assert_allclose(at("saga/boxes", "Boxes3D:half_sizes"), tracks.boxes.size / 2, atol=1e-3)
    labels = at("saga/boxes", "Boxes3D:labels")
    assert [label.split()[:2] for label in labels] == [
        [str(id_), label] for id_, label in zip(tracks.id.tolist(), tracks.boxes.label.tolist(), strict=True)
    ]
    assert len(at("saga/ellipses", "Ellipsoids3D:half_sizes")) == len(tracks)
    paths = at("saga/trajectories", "LineStrips3D:strips")
    assert max(map(len, paths)) == k + 1
    strips = np.array(at("saga/edges", "LineStrips3D:strips"))
    assert strips.shape[1:] == (2, 3)  # from the place of one track to that of another
    places = tracks.boxes.position - origin
    assert (np.abs(strips[:, :, None] - places).max(axis=3).min(axis=2) < 1e-3).all()
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


def test_the_ellipse_holds_ninety_percent():
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    size, (angle,) = ellipses(covariance[None])
    half = size[:, :2] / 2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(turn @ np.diag(half[0] ** 2) @ turn.T, HELD * covariance)
    points = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 20000) @ turn / half[0]
    assert np.mean(np.sum(points**2, axis=1) < 1) == pytest.approx(0.9, abs=0.01)


def test_kitti_with_scans_and_a_map(tmp_path):
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
    marks = [{"number": 2, "kind": "pole", "x": 3.0, "y": 4.0}, {"number": 3, "kind": "wall", "x": 0.0, "nx": 1.0}]
    (slam / "landmarks.json").write_text(json.dumps(marks))
    file = tmp_path / "k.rrd"
    result = run("kitti", root / "result", "--dataroot", root, "--detections", root / "found", "--slam", slam,
                 "--save", file)  # fmt: skip
    if "rerun-sdk" not in result.stderr and "pip install" in result.stderr:
        pytest.skip("rerun-sdk is not installed (extra [view])")
    assert result.exit_code == 0, result.output
    found = read_rrd(file)
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
    assert "/slam/trajectory" in read_rrd(alone)


def test_scans_of_nuscenes_are_found_where_their_files_are(tmp_path):
    content = tables()
    for row in content["calibrated_sensor"]:
        row |= {"translation": [0.9, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}
    for k, row in enumerate(content["sample_data"]):
        folder, name = ("samples", row["sample_token"]) if row["is_key_frame"] else ("sweeps", row["token"])
        channel = {"c-lidar": "LIDAR_TOP", "c-cam": "CAM_FRONT"}[row["calibrated_sensor_token"]]
        row |= {"filename": f"{folder}/{channel}/{name}.pcd.bin", "timestamp": 10**15 + k}
    root = write_tables(tmp_path, content)
    (root / "samples" / "LIDAR_TOP").mkdir(parents=True)
    np.array([[1, 2, 3, 0.5, 7]], dtype="<f4").tofile(root / "samples" / "LIDAR_TOP" / "a1.pcd.bin")
    scans = nuscenes_scans(root, root / VERSION, "scene-0103")
    assert len(scans) == 1
    assert scans[0].points.tolist() == [[1, 2, 3]]
    assert scans.world_T_ego[0, :3, 3].tolist() == [5, 0, 0]
    assert scans.ego_T_lidar[:3, 3].tolist() == [0.9, 0, 1.8]
    content["sample_data"][0]["filename"] = "../../LIDAR_TOP/passwd"
    with pytest.raises(InputError, match="expected a file below the dataroot"):
        nuscenes_scans(root, write_tables(tmp_path, content) / VERSION, "scene-0103")


def test_broken_slam_results_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"trajectory\.tum"):
        read_slam_view(tmp_path)
    write_tum_poses(tmp_path / "trajectory.tum", Trajectory(np.array([0.0]), np.eye(4)[None]))
    (tmp_path / "landmarks.json").write_text('[{"kind": "pole"}]')
    with pytest.raises(InputError, match="expected a list of landmarks"):
        read_slam_view(tmp_path)


def test_missing_extras_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'saga-fg[view]'" in refused("view", "file", tmp_path / "t.csv", "--save", tmp_path / "t.rrd")
    monkeypatch.setitem(sys.modules, "mcap_protobuf", None)
    assert "pip install 'saga-fg[mcap]'" in refused("view", "file", "tracks.csv", "--save", tmp_path / "t.mcap")
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_to_its_end_leaves_nothing(tmp_path, monkeypatch):
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra [view])")

    def full(stream: Any) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rerun.RecordingStream, "flush", full)
    with pytest.raises(InputError, match=r"a\.rrd: not written, is the disk full\? File-writer thread"):
        write_view(tmp_path / "a.rrd", "a", ["world"], [])
    assert not list(tmp_path.iterdir())


def test_what_a_view_may_not_be_written_to_is_refused(tmp_path):
    (tmp_path / "map.ply").write_text("points")
    said = refused("view", "slam", tmp_path, "--save", tmp_path / "map.ply")
    assert "map.ply: expected a file name that ends in .rrd (rerun) or .mcap (Foxglove)" in said
    assert (tmp_path / "map.ply").read_text() == "points"
    with pytest.raises(InputError, match=r"a\.bag: expected a file name that ends in \.rrd \(rerun\) or \.mcap"):
        write_view(tmp_path / "a.bag", "a", [], [])


# Views for Foxglove: the content of the file, read back by mcap's own reader with the schemas in the file

ROOT = "/scene-0001"


@dataclass(frozen=True, eq=False)
class TwoScans:
    """Scans of a place on the roof; the first is earlier than the scene."""

    timestamps: FloatArray
    world_T_ego: FloatArray = field(default_factory=lambda: np.tile(np.eye(4), (2, 1, 1)))
    ego_T_lidar: FloatArray = field(default_factory=lambda: yaw_transform(1.0, 0.0, 2.0, yaw=0.5))

    def __len__(self) -> int:
        return 2

    def __getitem__(self, row: int) -> Scan:
        return Scan.of(np.array([[1.0, 2.0, 3.0], [1.001, 2.0, 3.0], [4.0, 5.0, 6.0 + row]]))


@pytest.fixture(scope="module")
def shown() -> ReportScene:
    config = load_config("simulated")
    scene = SimulatedTraffic(SimulatorSettings(duration=1.0, warm_up=5.0), scenes=1, seed=1).scene("scene-0001")
    done = track_scene(scene, config.new_tracker("saga"))
    return scene_of_run({"saga": done}, config.tracker.edges, config.sensors)


@dataclass(frozen=True)
class Read:
    schema: str
    time: int
    content: Any


def read_mcap(path: Path) -> dict[str, list[Read]]:
    """Messages by topic, decoded with the schemas that the file brings."""
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed (extra [mcap])")
    decoder = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
    topics: dict[str, list[Read]] = {}
    with path.open("rb") as file:
        opened = reader.make_reader(file, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        for schema, channel, message, content in opened.iter_decoded_messages(log_time_order=False):
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            assert message.publish_time == message.log_time
            topics.setdefault(channel.topic, []).append(Read(schema.name, message.log_time, content))
    return topics


def seconds(stamp: Any) -> int:
    return int(stamp.seconds) * 10**9 + int(stamp.nanos)


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def test_every_message_is_complete_and_times_ascend(tmp_path, shown):
    start = float(shown.scene.timestamps[0])
    view = SceneView(shown, TwoScans(np.array([start - 0.1, start + 0.6])))
    write_view(tmp_path / "a.mcap", "a", ["scene-0001"], draw_scene(view))
    topics = read_mcap(tmp_path / "a.mcap")
    for topic, messages in topics.items():
        assert len({each.schema for each in messages}) == 1, topic
        times = [each.time for each in messages]
        assert times == sorted(set(times)), topic
        for each in messages:
            if each.schema == "foxglove.SceneUpdate":
                (deletion,) = each.content.deletions
                assert deletion.type == deletion.ALL
                assert {seconds(entity.timestamp) for entity in each.content.entities} <= {each.time}
                assert len({entity.id for entity in each.content.entities}) == len(each.content.entities)
    schemas = {each.schema for messages in topics.values() for each in messages}
    assert schemas == {"foxglove.SceneUpdate", "foxglove.FrameTransforms", "foxglove.PointCloud"}
    reader = pytest.importorskip("mcap.reader")
    with (tmp_path / "a.mcap").open("rb") as file:
        opened = reader.make_reader(file)
        summary = opened.get_summary()
        times = [message.log_time for _, _, message in opened.iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}


def test_tracks_truth_and_ego_are_where_the_result_has_them(tmp_path, shown):
    scene, table = shown.scene, shown.tracks["saga"]
    write_view(tmp_path / "a.mcap", "a", ["scene-0001"], draw_scene(SceneView(shown)))
    topics = read_mcap(tmp_path / "a.mcap")
    boxes = topics[f"{ROOT}/saga/boxes"]
    assert [len(each.content.entities) for each in boxes] == np.bincount(table.frame, minlength=len(scene)).tolist()
    np.testing.assert_allclose([each.time / 1e9 for each in boxes], scene.timestamps - scene.timestamps[0], atol=1e-6)
    origin, k = scene.world_T_ego[0, :3, 3], len(scene) - 1
    rows = np.flatnonzero(table.frame == k)
    entities = boxes[k].content.entities
    assert len(entities) > 5
    assert [entity.id for entity in entities] == table.id[rows].tolist()
    for entity, row in zip(entities, rows.tolist(), strict=True):
        assert entity.frame_id == "scene-0001"
        (cube,), (text,) = entity.cubes, entity.texts
        place, turn = cube.pose.position, cube.pose.orientation
        np.testing.assert_allclose(xyz(place), table.boxes.position[row] - origin, atol=1e-3)
        np.testing.assert_allclose(xyz(cube.size), table.boxes.size[row], atol=1e-3)
        yaw = 2 * np.arctan2(turn.z, turn.w)
        assert np.cos(yaw - table.boxes.yaw[row]) == pytest.approx(1.0, abs=1e-6)
        assert {each.key: each.value for each in entity.metadata} == {
            "id": table.id[row],
            "class": table.boxes.label[row],
            "score": f"{table.score[row]:.2f}",
        }
        assert text.text.startswith(f"{table.id[row]} ")

    def layer(name: str, kind: str) -> list[Any]:
        (entity,) = topics[f"{ROOT}/saga/{name}"][k].content.entities
        return list(getattr(entity, kind))

    def rgb(primitive: Any) -> tuple[float, float, float]:
        return primitive.color.r, primitive.color.g, primitive.color.b

    colours = [rgb(entity.cubes[0]) for entity in entities]
    of_class = class_colours(sorted(set(table.boxes.label.tolist())))
    expected = [bytes.fromhex(of_class[label][1:]) for label in table.boxes.label[rows].tolist()]
    np.testing.assert_allclose(255 * np.array(colours), [list(colour) for colour in expected], atol=1)
    velocity = table.boxes.velocity[rows]
    arrows = layer("velocities", "arrows")
    lengths = [arrow.shaft_length + arrow.head_length for arrow in arrows]
    np.testing.assert_allclose(lengths, np.hypot(*velocity.T), atol=2e-3)
    assert [rgb(arrow) for arrow in arrows] == colours
    paths = layer("trajectories", "lines")
    ends = [xyz(path.points[-1]) for path in paths]
    np.testing.assert_allclose(ends, table.boxes.position[rows] - origin, atol=1e-3)
    spread = [sphere.size.x * sphere.size.y for sphere in layer("ellipses", "spheres")]
    determinant = np.linalg.det(table.position_covariance[rows])
    np.testing.assert_allclose(spread, 4 * 2 * np.log(10) * np.sqrt(determinant), rtol=0.02)
    assert all(len(line.points) == 2 for line in layer("edges", "lines"))
    seen, hidden = (topics[f"{ROOT}/truth/{name}"][k].content.entities for name in ("seen", "hidden"))
    truth = scene.ground_truth[k]
    assert [entity.id for entity in seen] == truth.id[truth.visible].tolist()
    assert [entity.id for entity in hidden] == truth.id[~truth.visible].tolist()
    (transform,) = topics[f"{ROOT}/ego"][k].content.transforms
    assert (transform.parent_frame_id, transform.child_frame_id) == ("scene-0001", "scene-0001/ego")
    np.testing.assert_allclose(xyz(transform.translation), scene.world_T_ego[k, :3, 3] - origin, atol=1e-3)


PLACES = {"Boxes3D:centers", "Ellipsoids3D:centers", "Points3D:positions", "LineStrips3D:strips", "Arrows3D:origins"}


def places(message: Any) -> list[list[float]]:
    """Where a message of Foxglove has solids, points of lines, tails of arrows, points of a cloud, or a frame."""
    if hasattr(message, "transforms"):
        return [xyz(each.translation) for each in message.transforms]
    if hasattr(message, "data"):
        return np.frombuffer(message.data, dtype="<f4").reshape(-1, 3).tolist()
    found = []
    for entity in message.entities:
        found += [xyz(each.pose.position) for each in (*entity.cubes, *entity.spheres, *entity.arrows)]
        found += [xyz(point) for line in entity.lines for point in line.points]
    return found


def test_both_kinds_of_file_show_the_same(tmp_path, shown):
    view = SceneView(shown, TwoScans(shown.scene.timestamps[0] + np.array([0.0, 0.6])))
    found = {}
    for suffix in ("rrd", "mcap"):
        write_view(tmp_path / f"a.{suffix}", "a", ["scene-0001"], draw_scene(view))
    for topic, messages in read_mcap(tmp_path / "a.mcap").items():
        found[topic] = {round(each.time / 1e9, 6): places(each.content) for each in messages}
    rows = {}
    for entity, columns in read_rrd(tmp_path / "a.rrd").items():
        for name in columns.keys() & {*PLACES, "Transform3D:translation"}:
            rows[entity] = {
                round(time or 0.0, 6): np.concatenate(
                    [np.empty((0, 3)), *(np.reshape(each, (-1, 3)) for each in value)]
                )
                for time, value in columns[name].items()
            }
    assert rows.keys() == found.keys()
    assert {f"{ROOT}/{name}" for name in ("ego", "saga/boxes", "saga/trajectories", "truth/seen")} < rows.keys()
    for entity, at in rows.items():
        assert at.keys() == found[entity].keys(), entity
        for time, there in at.items():
            np.testing.assert_allclose(np.reshape(found[entity][time], (-1, 3)), there, atol=2e-3, err_msg=entity)


def test_the_command_writes_the_file_that_the_suffix_names(tmp_path):
    pytest.importorskip("mcap_protobuf", reason="mcap is not installed (extra [mcap])")
    slam = tmp_path / "slam"
    slam.mkdir()
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :2, 3] = 1.0
    write_tum_poses(slam / "trajectory.tum", Trajectory(np.array([0.0, 0.1]), poses))
    (slam / "landmarks.json").write_text('[{"number": 2, "kind": "pole", "x": 3.0, "y": 4.0}]')
    file = tmp_path / "s.mcap"
    told = done("view", "slam", slam, "--save", file)
    assert "open it in Foxglove" in told.stdout
    topics = read_mcap(file)
    ((entity,),) = (each.content.entities for each in topics["/slam/names"])
    assert [text.text for text in entity.texts] == ["pole 2"]
    assert [each.time for each in topics["/slam/pose"]] == [0, 100_000_000]


def test_a_drawing_that_fails_leaves_no_file(tmp_path, shown):
    pytest.importorskip("mcap_protobuf", reason="mcap is not installed (extra [mcap])")

    def broken() -> Any:
        yield next(draw_scene(SceneView(shown)))
        raise InputError("scan 7: broken")

    with pytest.raises(InputError, match="scan 7"):
        write_view(tmp_path / "a.mcap", "a", ["scene-0001"], broken())
    assert not list(tmp_path.iterdir())
