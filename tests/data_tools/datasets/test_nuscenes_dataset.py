"""nuScenes as a dataset: tables, splits, truth."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.nuscenes import NuScenes, split_scenes
from data_tools.datasets.nuscenes.source import read_scored_scenes
from data_tools.metrics import nuscenes_tracking_metrics
from saga_fg import Dataset, InputError
from saga_fg.numerics.geometry import yaw_of
from tests.data_tools.nuscenes_example import (
    SAMPLES,
    START,
    VERSION,
    Tables,
    annotation,
    box,
    results,
    tables,
    write_results,
    write_tables,
)


def dataset(tmp_path: Path, content: Tables | None = None, found: Any = None, **options: Any) -> NuScenes:
    write_tables(tmp_path, content)
    path = write_results(tmp_path / "found.json", found)
    options = {"scenes": ["scene-0103"]} | options
    return NuScenes(tmp_path, "v1.0-mini", {"lidar": path}, **options)


def test_scene_has_times_poses_and_tokens(tmp_path):
    data: Dataset = dataset(tmp_path)
    scene = data.scene("scene-0103")
    assert data.scenes == ("scene-0103",)
    assert scene.tokens == ("a0", "a1", "a2")
    np.testing.assert_allclose(scene.timestamps, START * 1e-6 + np.array([0, 0.5, 1]), rtol=0, atol=1e-6)
    # the pose of the LIDAR_TOP keyframe: neither the camera's nor the sweep's
    np.testing.assert_array_equal(scene.world_T_ego[:, :3, 3], [[0, 0, 0], [5, 0, 0], [10, 0, 0]])
    np.testing.assert_allclose(yaw_of(scene.world_T_ego[:, :3, :3]), np.pi / 2)
    assert scene.ground_truth is None


def test_frames_hold_the_detections_of_each_sample(tmp_path):
    scene = dataset(tmp_path).scene("scene-0103")
    assert [(frame.token, frame.sensor, len(frame)) for frame in scene.frames] == [
        ("a0", "lidar", 1),
        ("a1", "lidar", 0),
        ("a2", "lidar", 2),
    ]
    assert [frame.timestamp for frame in scene.frames] == scene.timestamps.tolist()
    (car,) = scene.frames[0].detections
    assert car.label == "car"
    assert car.position == (100.0, 50.0, 1.0)
    assert car.size == (4.0, 2.0, 1.5)  # length, width, height
    assert car.yaw == pytest.approx(np.pi / 2)
    assert np.isnan(car.velocity).all()
    assert car.score == 0.5
    last = scene.frames[2].detections
    assert last.boxes.label.tolist() == ["car", "traffic_cone"]
    np.testing.assert_array_equal(last.boxes.velocity, [[3, -1], [np.nan, np.nan]])
    np.testing.assert_array_equal(scene.frames[2].world_T_ego, scene.world_T_ego[2])
    assert scene.frames[2].coordinates == "world"


def test_velocity_may_be_unknown(tmp_path):
    found = results()
    for velocity in ({"velocity": None}, {"velocity": [float("nan")] * 2}, {}):
        found["a0"][0].pop("velocity", None)
        found["a0"][0] |= velocity
        scene = dataset(tmp_path, found=found).scene("scene-0103")
        assert np.isnan(scene.frames[0].detections.boxes.velocity).all()


def test_sample_that_is_not_listed_gets_no_frame_and_one_warning(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        data = dataset(tmp_path, scenes=list(SAMPLES))
        scene = data.scene("scene-0061")
    assert [frame.token for frame in scene.frames] == ["b0"]
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'found.json'}: lists 4 of 5 samples, the others get no frame"
    ]


def test_ground_truth(tmp_path):
    truth = dataset(tmp_path, ground_truth=True).scene("scene-0103").ground_truth
    assert [moment.id.tolist() for moment in truth] == [["i-car", "i-ped"], ["i-car"], ["i-car", "i-ped"]]
    assert truth[0].boxes.label.tolist() == ["car", "pedestrian"]
    assert [moment.visible.tolist() for moment in truth] == [[True, True], [False], [True, True]]
    np.testing.assert_array_equal(truth[0].boxes.size[0], [4.0, 2.0, 1.5])
    np.testing.assert_allclose(truth[0].boxes.yaw, np.pi / 2)
    np.testing.assert_allclose(truth[0].boxes.velocity, [[6, 0], [1, 0]], rtol=1e-6)  # one-sided
    np.testing.assert_allclose(truth[1].boxes.velocity, [[8, 2]], rtol=1e-6)  # central
    np.testing.assert_allclose(truth[2].boxes.velocity, [[10, 4], [1, 0]], rtol=1e-6)


def test_no_velocity_over_a_long_gap(tmp_path):
    content = tables()
    for k, sample in enumerate(content["sample"][:3]):
        sample["timestamp"] = START + 1_600_000 * k
    content["sample"][1]["timestamp"] -= 200_000  # 1.4 s and 1.8 s: one side too long, 3.2 s over both
    truth = dataset(tmp_path, content, ground_truth=True).scene("scene-0103").ground_truth
    known = [np.isfinite(moment.boxes.velocity[:, 0]).tolist() for moment in truth]
    assert known == [[True, False], [False], [False, False]]


# Broken tables: what is changed, and the one line that says so.


def change(table: str, row: int, **values: Any) -> Callable[[Tables], None]:
    return lambda content: content[table][row].update(values)


def drop(table: str, row: int, field: str | None = None) -> Callable[[Tables], None]:
    def apply(content: Tables) -> None:
        if field is None:
            del content[table][row]
        else:
            del content[table][row][field]

    return apply


BROKEN_TABLES = [
    (change("sample", 1, timestamp=START), r"sample\.json: record a1: timestamp: .* time repeats at"),
    (change("sample", 2, timestamp=START - 1), r"sample\.json: record a2: timestamp: .* time runs backwards at"),
    (change("sample", 1, timestamp="x"), r"record a1: timestamp: expected a whole number of microseconds, got 'x'"),
    (change("sample", 1, token="a0"), r"sample\.json: record a0: expected every token once, it occurs again"),
    (change("sample", 1, next="zz"), r"sample\.json: scene scene-0103: expected a sample 'zz', there is none"),
    (change("sample", 1, next="a0"), r"sample\.json: scene scene-0103: expected 3 samples, the chain goes on"),
    (change("sample", 1, next=""), r"sample\.json: scene scene-0103: expected 3 samples, got 2"),
    (change("sample", 1, next=None), r"sample\.json: record 1: next: expected a string, got None"),
    (change("scene", 0, name="scene-0061"), r"scene\.json: name: expected unique scene names, got 'scene-0061'"),
    (change("scene", 0, nbr_samples="3"), r"scene\.json: scene scene-0103: nbr_samples: expected a number, got '3'"),
    (drop("scene", 0, "name"), r"scene\.json: record 0 \(scene-0103\): field 'name' is missing"),
    (change("sensor", 0, channel="TOP"), r"sample_data\.json: sample a\d: expected a LIDAR_TOP keyframe"),
    (drop("ego_pose", 3), r"ego_pose\.json: expected pose 'p-a1-0' of sample a1, there is none"),
    (change("ego_pose", 3, rotation=[1, 1, 0, 0]), r"ego_pose\.json: record p-a1-0: rotation\[0\]: expected a unit"),
    (change("ego_pose", 3, translation=["x"]), r"ego_pose\.json: record p-a1-0: translation: expected three numbers"),
    (change("ego_pose", 3, translation=[1, float("nan"), 0]), r"ego_pose\.json: record p-a1-0: pose\[1, 3\]: expec"),
    (change("instance", 0, category_token="zz"), r"instance\.json: record i-car: expected a category, 'zz' is none"),
    (change("sample_annotation", 0, instance_token="zz"), r"sample a1: instance_token: expected an instance, 'zz'"),
    (change("sample_annotation", 0, size=[1, 2]), r"sample a1, instance i-car: expected 3, 3 and 4 numbers"),
    (change("sample_annotation", 0, size=[1, 0, 1]), r"scene scene-0103: size\[0\]: expected positive"),
    (change("sample_annotation", 0, rotation=[2, 0, 0, 0]), r"scene scene-0103: rotation\[0\]: expected a unit quat"),
    (change("sample_annotation", 0, sample_token="a0"), r"sample a0: id: expected unique object ids"),
]


def test_broken_table(tmp_path, subtests):
    for apply, message in BROKEN_TABLES:
        with subtests.test(message):
            content = tables()
            apply(content)
            with pytest.raises(InputError, match=message) as caught:
                dataset(tmp_path, content, ground_truth=True)
            assert "\n" not in str(caught.value)


def test_tables_that_are_missing_cut_off_or_no_tables(tmp_path, subtests):
    for table in list(tables()):
        with subtests.test(table=table):
            write_tables(tmp_path)
            path = tmp_path / "v1.0-mini" / f"{table}.json"
            path.write_text(path.read_text()[:-20])
            with pytest.raises(InputError, match=rf"{table}\.json: character \d+: "):
                NuScenes(tmp_path, "v1.0-mini", {}, ground_truth=True)
            path.unlink()
            with pytest.raises(InputError, match=rf"v1\.0-mini/{table}\.json: missing table '{table}'"):
                NuScenes(tmp_path, "v1.0-mini", {}, ground_truth=True)
    (tmp_path / "v1.0-mini" / "scene.json").write_text("[7]")
    with pytest.raises(InputError, match=r"scene\.json: record 0: expected an object with fields name, "):
        NuScenes(tmp_path, "v1.0-mini", {})
    with pytest.raises(InputError, match=r"v1\.0-trainval: expected the folder .*versions there: v1\.0-mini"):
        NuScenes(tmp_path, "v1.0-trainval", {})


def test_annotations_are_read_only_when_asked_for(tmp_path):
    write_tables(tmp_path)
    (tmp_path / "v1.0-mini" / "sample_annotation.json").unlink()
    assert NuScenes(tmp_path, "v1.0-mini", {}).scene("scene-0103").ground_truth is None


def test_unknown_scene_suggests_the_nearest(tmp_path):
    with pytest.raises(InputError, match=r"scene\.json: unknown scene 'scene-0013'; did you mean 'scene-0103'"):
        dataset(tmp_path, scenes=["scene-0013"])
    with pytest.raises(InputError, match="unknown scene 'scene-0061'"):
        dataset(tmp_path).scene("scene-0061")  # in the tables, but not chosen


# Broken detections.

BROKEN_BOXES = [
    ({"translation": [1, float("nan"), 0]}, r"translation: expected three finite numbers in m, got \[1\.0, nan,"),
    ({"translation": [1, 2]}, r"translation: expected 3 numbers, got '\[1, 2\]'"),
    ({"size": [2, -4, 1]}, r"size: expected positive width, length, height in m, got \[2\.0, -4\.0, 1\.0\]"),
    ({"size": [2, None, 1]}, r"size: expected 3 numbers"),
    ({"rotation": [1, 1, 0, 0]}, r"rotation: expected a unit quaternion \(w, x, y, z\), got \[1\.0, 1\.0, 0"),
    ({"velocity": [float("inf"), 0]}, r"velocity: expected finite numbers, or NaN for unknown"),
    ({"detection_score": float("nan")}, r"detection_score: expected a finite number, got nan"),
    ({"detection_score": "high"}, r"detection_score: expected a number, got 'high'"),
    ({"detection_name": "cra"}, r"detection_name: unknown class 'cra'; did you mean 'car'"),
    ({"detection_name": 3}, r"detection_name: expected a string, got 3"),
]


def test_broken_box_names_file_sample_box_and_field(tmp_path, subtests):
    for values, message in BROKEN_BOXES:
        with subtests.test(message):
            found = results()
            found["a2"][1].update(values)
            with pytest.raises(InputError, match=rf"found\.json: sample a2: box 1: {message}") as caught:
                dataset(tmp_path, found=found)
            assert "\n" not in str(caught.value)
    for field in ["translation", "size", "rotation", "detection_name", "detection_score"]:
        with subtests.test(field=field):
            found = results()
            del found["a2"][1][field]
            with pytest.raises(InputError, match=rf"found\.json: sample a2: box 1: field '{field}' is missing"):
                dataset(tmp_path, found=found)


def test_broken_results(tmp_path, subtests):
    for found, message in [
        ({"a0": [], "xyz": []}, r"sample xyz: expected samples of the tables, they hold no such sample"),
        ({"b0": []}, r"expected detections of scene scene-0103, the file lists none of its samples"),
        ({"a0": {}}, r"sample a0: expected a list of boxes, got '\{\}'"),
        ({"a0": [3]}, r"sample a0: box 0: expected an object, got 3"),
        ({"a0": [box("a1")]}, r"sample a0: sample_token: expected the sample's own, got 'a1'"),
        ([], r"character \d+: expected '\{'"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=rf"found\.json: {message}"):
            dataset(tmp_path, found=found)


def test_broken_result_file(tmp_path, subtests):
    for text, message in [
        ('{"meta": {}}', "expected a field 'results'"),
        ('{"meta": 1, "results": {}}', "meta: expected an object"),
        ('{"meta": {}, "results": {"a0": [], "a0": []}}', "sample a0: expected each sample once"),
        ('{"meta": {}, "results": {"a0": [{"samp', "character 31: broken or truncated JSON"),
        ("", r"character 0: expected '\{', the file ends"),
    ]:
        with subtests.test(message):
            write_tables(tmp_path)
            path = tmp_path / "found.json"
            path.write_text(text)
            with pytest.raises(InputError, match=rf"found\.json: {message}"):
                NuScenes(tmp_path, "v1.0-mini", {"lidar": path})


def test_scene_that_a_sensor_never_saw(tmp_path):
    write_tables(tmp_path)
    path = write_results(tmp_path / "found.json", {"a0": []})
    data = NuScenes(tmp_path, "v1.0-mini", {"lidar": path})  # no scene was asked for yet
    assert len(data.scene("scene-0103").frames) == 1
    with pytest.raises(InputError, match="expected detections of scene scene-0061"):
        data.scene("scene-0061")


def scenes(root: Path, version: str, names: list[str], splits: object = None) -> Path:
    folder = root / version
    folder.mkdir()
    (folder / "scene.json").write_text(json.dumps([{"name": name} for name in names]))
    if splits is not None:
        (folder / "splits.json").write_text(json.dumps(splits))
    return root


def test_official_mini_splits(tmp_path):
    write_tables(tmp_path)
    assert split_scenes(tmp_path, "v1.0-mini", "mini_val") == ("scene-0103",)
    assert split_scenes(tmp_path, "v1.0-mini", "mini_train") == ("scene-0061",)


def test_official_trainval_splits(tmp_path):
    names = [f"scene-{n:04}" for n in (1, 3, 4, 12, 18, 19, 92, 110, 1059, 1073, 1074, 1110)]
    root = scenes(tmp_path, "v1.0-trainval", names)
    val = {name for name in names if int(name[-4:]) in (3, 12, 18, 92, 110, 1059, 1073)}
    assert set(split_scenes(root, "v1.0-trainval", "val")) == val
    assert set(split_scenes(root, "v1.0-trainval", "train")) == set(names) - val
    detect = split_scenes(root, "v1.0-trainval", "train_detect")
    assert detect == ("scene-0001", "scene-1074")
    assert set(split_scenes(root, "v1.0-trainval", "train_track")) == set(names) - val - set(detect)


def test_splits_of_the_test_version_and_of_ones_own(tmp_path):
    root = scenes(tmp_path, "v1.0-test", ["scene-0077", "scene-0078"])
    assert split_scenes(root, "v1.0-test", "test") == ("scene-0077", "scene-0078")
    root = scenes(tmp_path, "v1.0-mini", ["a", "b", "c"], {"mine": ["c", "a", "absent"]})
    assert split_scenes(root, "v1.0-mini", "mine") == ("a", "c")


def test_splits_that_cannot_be_found(tmp_path, subtests):
    root = scenes(tmp_path, "v1.0-mini", ["a"], {"mine": ["a"], "none": []})
    for split, message in (
        ("mini_vall", r"splits\.json: unknown split 'mini_vall'; did you mean 'mini_val'\? .*: mini_train, mini"),
        ("train", r"split train belongs to v1\.0-trainval, the tables read are v1\.0-mini"),
        ("none", r"expected scenes of split none, the table holds none of them"),
    ):
        with subtests.test(split), pytest.raises(InputError, match=message):
            split_scenes(root, "v1.0-mini", split)
    for content in (["a"], {"mine": "a"}, {"mine": [1]}):
        (root / "v1.0-mini" / "splits.json").write_text(json.dumps(content))
        with subtests.test(content=content), pytest.raises(InputError, match="expected an object of lists"):
            split_scenes(root, "v1.0-mini", "mine")
    with pytest.raises(InputError, match="scene mine: expected a name scene-NNNN"):
        split_scenes(scenes(tmp_path, "v1.0-trainval", ["mine"]), "v1.0-trainval", "val")


# A result file beside its ground truth: what is read, and what is refused


def tracked(sample: str, track: str = "t", **changes: Any) -> dict[str, Any]:
    """A tracked car in the official format."""
    fields = {k: v for k, v in box(sample, velocity=[0.0, 0.0]).items() if not k.startswith(("detection", "attribute"))}
    return fields | {"tracking_id": track, "tracking_name": "car", "tracking_score": 0.5} | changes


def write(path: Path, results: dict[str, Any]) -> Path:
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results}))
    return path


def content_with_rack() -> dict[str, list[dict[str, Any]]]:
    content = tables()
    content["category"].append({"token": "k-rack", "name": "static_object.bicycle_rack"})
    content["instance"].append({"token": "i-rack", "category_token": "k-rack"})
    content["sample_annotation"].append(annotation("a1", "i-rack", [20.0, 3.0, 1.0], points=0))
    return content


def test_truth_tracks_and_racks_of_each_sample(tmp_path):
    content = content_with_rack()
    content["sample_annotation"][1]["num_lidar_pts"] = 10**40  # it is asked only whether there are any
    root = write_tables(tmp_path, content)
    results = {"a0": [tracked("a0"), tracked("a0", "u")], "a1": [], "a2": [tracked("a2")], "b0": []}
    (scored,) = read_scored_scenes(write(tmp_path / "r.json", results), root, VERSION, ["scene-0103"]).values()
    scene = scored.tracking
    assert [len(truth) for truth in scored.scene.ground_truth or ()] == [2, 1, 2]  # seen or not
    assert np.diff(scene.timestamps) == pytest.approx([0.5, 0.5])
    assert scene.ego_position.tolist() == [[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]]
    assert scene.truth.frame.tolist() == [0, 0, 2, 2]  # the car has no point at a1, the barrier is not tracked
    assert sorted(scene.truth.id.tolist()) == ["i-car", "i-car", "i-ped", "i-ped"]
    assert scene.found.frame.tolist() == [0, 0, 2]
    assert scene.found.id.tolist() == ["t", "u", "t"]
    assert [len(racks) for racks in scene.racks] == [0, 1, 0]
    rack = scene.racks[1]
    assert rack.position.tolist() == [[20.0, 3.0, 1.0]]
    assert rack.size.tolist() == [[4.0, 2.0, 1.5]]  # length, width, height
    assert rack.yaw == pytest.approx([np.pi / 2])
    assert nuscenes_tracking_metrics([scene]).overall.gt == 0  # all is further than 50 m from the vehicle


def test_a_missing_sample_is_refused(tmp_path):
    root = write_tables(tmp_path)
    result = write(tmp_path / "r.json", {"a0": [], "a2": []})
    with pytest.raises(InputError, match=r"r\.json: expected every sample of scene scene-0103, a1 is missing"):
        read_scored_scenes(result, root, VERSION, ["scene-0103"])
