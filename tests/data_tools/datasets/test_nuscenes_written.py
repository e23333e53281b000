"""What is written in the layout of nuScenes is read again."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.nuscenes import (
    NuScenes,
    ResultMeta,
    read_tracking_results,
    split_scenes,
    write_nuscenes,
    write_tracking_results,
)
from data_tools.simulator import SimulatedTraffic, SimulatorSettings, lidar
from saga_fg import Boxes, Scene, Tracks
from saga_fg.errors import InputError

SHORT = SimulatorSettings(duration=4.0, warm_up=5.0)
TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"),
    *("sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)
ORDER = np.array([1, 0, 2])  # width, length, height


def write(folder: Path, traffic: SimulatedTraffic) -> None:
    write_nuscenes(folder, traffic, traffic.mounts)


@pytest.fixture(scope="module")
def dataset() -> SimulatedTraffic:
    return SimulatedTraffic(SHORT, scenes=2, seed=4)


@pytest.fixture(scope="module")
def root(dataset: SimulatedTraffic, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "data"
    write_nuscenes(folder, dataset, dataset.mounts)
    return folder


@pytest.fixture(scope="module")
def tables(root: Path) -> dict[str, list[dict[str, Any]]]:
    return {name: json.loads((root / "v1.0-mini" / f"{name}.json").read_text()) for name in TABLES}


def test_our_reader_gets_the_scenes_back_at_two_hertz(dataset, root):
    files = {name: root / "detections" / f"{name}.json" for name in ("lidar", "camera")}
    read = NuScenes(root, "v1.0-mini", files, ground_truth=True)
    assert read.scenes == dataset.scenes
    assert (read.meta.use_lidar, read.meta.use_camera, read.meta.use_radar) == (True, True, False)
    assert split_scenes(root, "v1.0-mini", "all") == dataset.scenes
    for name in dataset.scenes:
        made, back = dataset.scene(name), read.scene(name)
        assert back.timestamps == pytest.approx(made.timestamps[::5], abs=1e-6)
        assert back.world_T_ego == pytest.approx(made.world_T_ego[::5], abs=1e-6)
        assert back.ground_truth is not None
        for a, b in zip(made.ground_truth[::5], back.ground_truth, strict=True):
            left, right = (np.lexsort(t.boxes.position.round(3).T) for t in (a, b))
            assert b.boxes.position[right] == pytest.approx(a.boxes.position[left], abs=1e-5)
            assert b.boxes.size[right] == pytest.approx(a.boxes.size[left], abs=1e-5)
            assert np.cos(b.boxes.yaw[right] - a.boxes.yaw[left]) == pytest.approx(1.0)
            assert b.boxes.label[right].tolist() == a.boxes.label[left].tolist()
            assert b.visible[right].tolist() == a.visible[left].tolist()


def test_detections_are_those_of_the_nearest_frame_at_the_samples_time(dataset, root):
    files = {name: root / "detections" / f"{name}.json" for name in ("lidar", "camera")}
    read = NuScenes(root, "v1.0-mini", files)
    made, back = dataset.scene("scene-0001"), read.scene("scene-0001")
    assert len(back.frames) == 2 * len(back)
    for frame in back.frames:
        own = [f for f in made.frames if f.sensor == frame.sensor]
        source = min(own, key=lambda f: abs(f.timestamp - frame.timestamp))
        delay = frame.timestamp - source.timestamp
        assert abs(delay) < (1e-5 if frame.sensor == "lidar" else 0.5 / 12 + 1e-5)
        moved = source.detections.boxes.position.copy()
        moved[:, :2] += delay * np.nan_to_num(source.detections.boxes.velocity)
        assert frame.detections.boxes.position == pytest.approx(moved, abs=1e-4)
        assert frame.detections.score == pytest.approx(source.detections.score, abs=1e-6)
        velocity = source.detections.boxes.velocity
        assert np.allclose(frame.detections.boxes.velocity, velocity, atol=1e-4, equal_nan=True)


def test_tokens_are_unique_and_every_reference_is_to_a_record(tables):
    tokens = {name: [record["token"] for record in records] for name, records in tables.items()}
    for name, column in tokens.items():
        assert column or name == "attribute", name
        assert len(set(column)) == len(column), name
    targets = {
        **{f"{name}_token": name for name in TABLES},
        **{f"{end}_sample_token": "sample" for end in ("first", "last")},
        **{f"{end}_annotation_token": "sample_annotation" for end in ("first", "last")},
    }
    for name, records in tables.items():
        for record in records:
            for field, value in record.items():
                if field in targets:
                    assert value in tokens[targets[field]], (name, field)
                if field in ("prev", "next") and value:
                    assert value in tokens[name], (name, field)
                if field.endswith("_tokens"):
                    assert set(value) <= set(tokens[field.removesuffix("_tokens")]), (name, field)


@pytest.mark.parametrize("table", ["sample", "sample_data", "sample_annotation"])
def test_records_are_linked_in_order_of_time(tables, table):
    records = {record["token"]: record for record in tables[table]}
    samples = {record["token"]: record["timestamp"] for record in tables["sample"]}

    def time(record: dict[str, Any]) -> int:
        return int(record["timestamp"] if "timestamp" in record else samples[record["sample_token"]])

    starts = [record for record in tables[table] if not record["prev"]]
    owners = {"sample": "scene", "sample_data": "calibrated_sensor", "sample_annotation": "instance"}
    assert len(starts) == len(tables[owners[table]])
    walked = 0
    for record in starts:
        walked += 1
        while record["next"]:
            after = records[record["next"]]
            assert after["prev"] == record["token"]
            assert time(after) > time(record)
            record, walked = after, walked + 1
    assert walked == len(records)


def test_hidden_objects_hold_no_points_and_boxes_are_in_the_order_of_the_format(tables, dataset):
    levels = {(record["num_lidar_pts"] > 0, record["visibility_token"]) for record in tables["sample_annotation"]}
    assert levels <= {(True, "4"), (False, "1")}
    truth = dataset.scene("scene-0001").ground_truth
    first = tables["scene"][0]["first_sample_token"]
    sizes = [r["size"] for r in tables["sample_annotation"] if r["sample_token"] == first]
    assert sorted(sizes) == sorted(truth[0].boxes.size[:, ORDER].round(6).tolist())


def test_writing_is_all_or_nothing(tmp_path):
    class Breaks(SimulatedTraffic):
        def scene(self, name: str) -> Any:
            if name == "scene-0002":
                raise KeyboardInterrupt
            return super().scene(name)

    tiny = SimulatorSettings(duration=1.0, warm_up=0.0, sensors={"front lidar": lidar()})
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", Breaks(tiny, scenes=2))
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / "out", SimulatedTraffic(tiny, scenes=1))
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    read = NuScenes(tmp_path / "out", "v1.0-mini", {"x": tmp_path / "out" / "detections" / "front lidar.json"})
    assert len(read.scene("scene-0001")) == 2  # without a sensor named lidar the poses are there all the same


META = ResultMeta(use_lidar=True)


def scene(name: str = "scene-1", tokens: Sequence[str] = ("a", "b")) -> Scene:
    k = len(tokens)
    return Scene(name, np.arange(k, dtype=float), np.tile(np.eye(4), (k, 1, 1)), tuple(tokens), ())


def tracks(
    ids: Sequence[int] = (7,),
    labels: Sequence[str] = ("car",),
    score: Sequence[float] = (0.5,),
    size: Sequence[float] = (4, 2, 1.5),
    yaw: float = 0.25,
    velocity: Sequence[float] = (3, -1),
) -> Tracks:
    n = len(ids)
    position = np.arange(3 * n, dtype=float).reshape(n, 3)
    boxes = Boxes.of(labels, position, np.tile(size, (n, 1)), np.full(n, yaw), np.tile(velocity, (n, 1)))
    covariance = np.tile([[0.5, 0.1], [0.1, 0.25]], (n, 1, 1))
    return Tracks(0.0, np.array(ids), boxes, np.array(score), covariance, covariance, np.zeros(n))


def test_the_official_layout(tmp_path):
    path = tmp_path / "out.json"
    write_tracking_results(path, [(scene(), [tracks(), Tracks.empty(1.0)])], META)
    content = json.loads(path.read_text(), parse_constant=pytest.fail)  # NaN is no JSON
    assert content["meta"] == {
        "use_camera": False,
        "use_lidar": True,
        "use_radar": False,
        "use_map": False,
        "use_external": False,
    }
    assert content["results"]["b"] == []
    (box,) = content["results"]["a"]
    assert box.pop("rotation") == pytest.approx([np.cos(0.125), 0, 0, np.sin(0.125)])
    assert box == {
        "sample_token": "a",
        "translation": [0.0, 1.0, 2.0],
        "size": [2.0, 4.0, 1.5],
        "velocity": [3.0, -1.0],
        "tracking_id": "scene-1-7",
        "tracking_name": "car",
        "tracking_score": 0.5,
        "position_covariance": [0.5, 0.1, 0.25],
    }


def test_written_and_read_again(tmp_path):
    path = tmp_path / "out.json"
    written = tracks((1, 2), ("car", "pedestrian"), (0.1, 1), yaw=-3.0)
    write_tracking_results(path, [(scene(), [written, written]), (scene("scene-2", ["c"]), [Tracks.empty(0.0)])], META)
    result = read_tracking_results(path)
    assert result.meta == META
    assert list(result.samples) == ["a", "b", "c"]
    read = result.samples["b"]
    assert read.id.tolist() == ["scene-1-1", "scene-1-2"]
    assert read.boxes.label.tolist() == ["car", "pedestrian"]
    assert read.score.tolist() == [0.1, 1.0]
    for name in ("position", "size", "yaw", "velocity"):
        np.testing.assert_allclose(getattr(read.boxes, name), getattr(written.boxes, name), atol=1e-6)
    np.testing.assert_array_equal(read.position_covariance, written.position_covariance)
    assert len(result.samples["c"]) == 0


def test_covariances_are_not_required_but_checked(tmp_path):
    path = tmp_path / "out.json"
    write_tracking_results(path, [(scene(), [tracks(), tracks()])], META)
    content = json.loads(path.read_text())
    del content["results"]["a"][0]["position_covariance"]
    path.write_text(json.dumps(content))
    samples = read_tracking_results(path).samples
    assert np.isnan(samples["a"].position_covariance).all()
    assert np.isfinite(samples["b"].position_covariance).all()
    content["results"]["a"][0]["position_covariance"] = [1.0, 2.0]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="sample a: box 0: position_covariance: expected 3 numbers"):
        read_tracking_results(path)


def written_and_read(folder: Path, *scenes: tuple[Scene, list[Tracks]]) -> dict[str, Any]:
    write_tracking_results(folder / "out.json", scenes, META)
    return dict(read_tracking_results(folder / "out.json").samples)


def test_ids_of_two_scenes_differ_and_classes_of_the_format_stay(tmp_path):
    samples = written_and_read(tmp_path, (scene("x", ["a"]), [tracks()]), (scene("y", ["b"]), [tracks()]))
    assert (samples["a"].id.tolist(), samples["b"].id.tolist()) == (["x-7"], ["y-7"])
    samples = written_and_read(tmp_path, (scene(), [tracks(), tracks(labels=["bus"])]))
    assert (samples["a"].id.tolist(), samples["b"].id.tolist()) == (["scene-1-7"], ["scene-1-7-bus"])


def test_only_tracking_classes_are_written_and_unknown_velocities_are_zero(tmp_path):
    one = scene(tokens=["a"])
    assert written_and_read(tmp_path, (one, [tracks(velocity=(np.nan, np.nan))]))["a"].boxes.velocity.tolist() == [
        [0, 0]
    ]
    mixed = tracks((1, 2, 3), ("barrier", "bus", "traffic_cone"), (1, 1, 1))
    assert written_and_read(tmp_path, (one, [mixed]))["a"].boxes.label.tolist() == ["bus"]


def test_the_best_500_boxes_are_kept(tmp_path):
    score = np.random.default_rng(0).permutation(600) / 600
    kept = written_and_read(tmp_path, (scene(tokens=["a"]), [tracks(range(600), ["car"] * 600, score)]))["a"]
    assert len(kept) == 500
    assert kept.score.min() == 100 / 600


def test_tracks_that_cannot_be_written(tmp_path, subtests):
    for moments, message in [
        ([tracks()], "expected tracks for 2 samples, got 1"),
        ([tracks(size=(np.nan, 2, 1)), tracks()], "sample a: track 7: expected a known size and heading"),
        ([tracks(yaw=np.nan), tracks()], "sample a: track 7: expected a known size and heading"),
    ]:
        with subtests.test(message):
            path = tmp_path / "out.json"
            with pytest.raises(InputError, match=rf"out\.json: scene scene-1: {message}"):
                write_tracking_results(path, [(scene(), moments)], META)
            assert list(tmp_path.iterdir()) == []


def test_every_sample_needs_a_token(tmp_path, subtests):
    for tokens in [("", "b"), ("a", "a")]:
        with (
            subtests.test(tokens=tokens),
            pytest.raises(InputError, match="expected a token of its own for every sample"),
        ):
            write_tracking_results(tmp_path / "out.json", [(scene(tokens=tokens), [tracks(), tracks()])], META)


def test_broken_tracking_file(tmp_path, subtests):
    for change, message in [
        ({"tracking_name": "barrier"}, "sample a: box 1: tracking_name: unknown class 'barrier'"),
        ({"tracking_id": "scene-1-1"}, "sample a: tracking_id: expected each track at most once"),
        ({"tracking_id": 4}, "sample a: box 1: tracking_id: expected a string, got 4"),
        ({"tracking_score": None}, "sample a: box 1: tracking_score: expected a number, got 'None'"),
    ]:
        with subtests.test(message):
            path = tmp_path / "out.json"
            write_tracking_results(path, [(scene(tokens=["a"]), [tracks((1, 2), ("car", "car"), (1, 1))])], META)
            content = json.loads(path.read_text())
            content["results"]["a"][1].update(change)
            path.write_text(json.dumps(content))
            with pytest.raises(InputError, match=rf"out\.json: {message}"):
                read_tracking_results(path)
