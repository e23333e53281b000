"""Simulated scenes written in the nuScenes layout and read back; what the official development kit relies on holds."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.datasets.nuscenes import NuScenes, write_nuscenes
from data_tools.datasets.nuscenes.writer import BLACK_PIXEL
from data_tools.simulator import SimulatedTraffic, SimulatorSettings, lidar
from data_tools.simulator.settings import TrafficSettings
from saga_fg.errors import InputError

SHORT = SimulatorSettings(duration=4.0, warm_up=5.0)
TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"),
    *("sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)
ORDER = np.array([1, 0, 2])  # width, length, height


def write(folder: Path, traffic: SimulatedTraffic, version: str = "v1.0-mini") -> None:
    write_nuscenes(folder, traffic, traffic.mounts, version)


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


def test_our_reader_gets_the_scenes_back_at_two_hertz(dataset: SimulatedTraffic, root: Path) -> None:
    files = {name: root / "detections" / f"{name}.json" for name in ("lidar", "camera")}
    read = NuScenes(root, "v1.0-mini", files, ground_truth=True)
    assert read.scenes == dataset.scenes
    assert (read.meta.use_lidar, read.meta.use_camera, read.meta.use_radar) == (True, True, False)
    assert read.split("all") == dataset.scenes
    for name in dataset.scenes:
        made, back = dataset.scene(name), read.scene(name)
        assert back.timestamps == pytest.approx(made.timestamps[::5], abs=1e-6)
        assert back.world_T_ego == pytest.approx(made.world_T_ego[::5], abs=1e-6)
        assert made.ground_truth is not None
        assert back.ground_truth is not None
        for a, b in zip(made.ground_truth[::5], back.ground_truth, strict=True):
            left, right = (np.lexsort(t.boxes.position.round(3).T) for t in (a, b))
            assert b.boxes.position[right] == pytest.approx(a.boxes.position[left], abs=1e-5)
            assert b.boxes.size[right] == pytest.approx(a.boxes.size[left], abs=1e-5)
            assert np.cos(b.boxes.yaw[right] - a.boxes.yaw[left]) == pytest.approx(1.0)
            assert b.boxes.label[right].tolist() == a.boxes.label[left].tolist()
            assert b.visible[right].tolist() == a.visible[left].tolist()


def test_detections_are_those_of_the_nearest_frame_at_the_samples_time(dataset: SimulatedTraffic, root: Path) -> None:
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


def test_tokens_are_unique_and_every_reference_is_to_a_record(tables: dict[str, list[dict[str, Any]]]) -> None:
    tokens = {name: [record["token"] for record in records] for name, records in tables.items()}
    for name, column in tokens.items():
        assert column, name
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
def test_records_are_linked_in_order_of_time(tables: dict[str, list[dict[str, Any]]], table: str) -> None:
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


def test_every_sample_has_one_keyframe_of_each_sensor(tables: dict[str, list[dict[str, Any]]]) -> None:
    channel = {record["token"]: record["channel"] for record in tables["sensor"]}
    mounted = {record["token"]: channel[record["sensor_token"]] for record in tables["calibrated_sensor"]}
    time = {record["token"]: record["timestamp"] for record in tables["sample"]}
    found: dict[str, list[str]] = {sample: [] for sample in time}
    for record in tables["sample_data"]:
        if record["is_key_frame"]:
            name = mounted[record["calibrated_sensor_token"]]
            found[record["sample_token"]].append(name)
            apart = abs(record["timestamp"] - time[record["sample_token"]])
            assert apart == 0 if name == "LIDAR_TOP" else apart < 42_000
    assert all(sorted(names) == ["CAM_FRONT", "LIDAR_TOP"] for names in found.values())


def test_hidden_objects_hold_no_points_and_boxes_are_in_the_order_of_the_format(
    tables: dict[str, list[dict[str, Any]]], dataset: SimulatedTraffic
) -> None:
    levels = {(record["num_lidar_pts"] > 0, record["visibility_token"]) for record in tables["sample_annotation"]}
    assert levels <= {(True, "4"), (False, "1")}
    truth = dataset.scene("scene-0001").ground_truth
    assert truth is not None
    first = tables["scene"][0]["first_sample_token"]
    sizes = [r["size"] for r in tables["sample_annotation"] if r["sample_token"] == first]
    assert sorted(sizes) == sorted(truth[0].boxes.size[:, ORDER].round(6).tolist())


def test_writing_is_all_or_nothing(tmp_path: Path) -> None:
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


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected the name of a folder"):
        write(tmp_path / "file", SimulatedTraffic(SHORT, scenes=1))
    with pytest.raises(InputError, match="version: expected a plain name"):
        write(tmp_path / "out", SimulatedTraffic(SHORT, scenes=1), version="../v1.0-mini")


def test_classes_beyond_vehicles_and_pedestrians_have_their_categories(tmp_path: Path) -> None:
    traffic = TrafficSettings(truck_share=0.7, bus_share=0.0, trailer_share=1.0)
    settings = SimulatorSettings(duration=2.0, warm_up=5.0, traffic=traffic)
    write(tmp_path / "out", SimulatedTraffic(settings, scenes=1))
    folder = tmp_path / "out" / "v1.0-mini"
    categories = {record["token"]: record["name"] for record in json.loads((folder / "category.json").read_text())}
    instances = json.loads((folder / "instance.json").read_text())
    assert "vehicle.trailer" in {categories[record["category_token"]] for record in instances}


def test_the_placeholder_map_is_a_png_image() -> None:
    content = BLACK_PIXEL
    assert content.startswith(b"\x89PNG\r\n\x1a\n")
    assert content[12:16] == b"IHDR"
    assert content.endswith(b"IEND\xae\x42\x60\x82")
    start = content.index(b"IDAT") + 4
    assert zlib.decompress(content[start : start + int.from_bytes(content[start - 8 : start - 4], "big")]) == b"\0\0"
