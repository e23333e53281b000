"""`saga-fg simulate` and `saga-fg track` on what it made: files in, files out, and every mistake in one line."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

from data_tools.datasets.nuscenes import NuScenes, read_tracking_results
from tests.pipelines.command import saga_fg

METHODS = ("saga", "kf", "centerpoint")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    result = saga_fg(
        "simulate", "-o", folder / "data", "--scenes", "2", "--seed", "3", "--config", folder / "short.yaml"
    )
    assert result.exit_code == 0, result.output
    return folder / "data"


def arguments(simulated: Path, output: Path) -> list[str | Path]:
    detections = f"lidar={simulated / 'detections' / 'lidar.json'}"
    return ["track", "nuscenes", "--dataroot", simulated, "--detections", detections, "--output", output]


@pytest.mark.parametrize("method", ["saga", "centerpoint"])
def test_nuscenes_results_list_every_sample_of_the_split(simulated: Path, tmp_path: Path, method: str) -> None:
    output = tmp_path / "tracks.json"
    result = saga_fg(*arguments(simulated, output), "--split", "all", "--method", method)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(f"{output}: 2 scenes, 16 frames, ")
    assert result.stdout.rstrip().endswith("frames/s")
    assert re.search(r", \d+ tracks \(\d+ with a score above 0\.5\), ", result.stdout)
    results = read_tracking_results(output)
    dataset = NuScenes(simulated, "v1.0-mini", {})
    assert set(results.samples) == {token for name in dataset.scenes for token in dataset.scene(name).tokens}
    assert sum(len(boxes) for boxes in results.samples.values()) > 20
    assert results.meta.use_lidar
    assert not results.meta.use_camera


def test_two_sensors_and_chosen_scenes(simulated: Path, tmp_path: Path) -> None:
    output = tmp_path / "tracks.json"
    camera = f"camera={simulated / 'detections' / 'camera.json'}"
    result = saga_fg(*arguments(simulated, output), "--detections", camera, "--scenes", "scene-0002")
    assert result.exit_code == 0, result.output
    results = read_tracking_results(output)
    assert results.meta.use_lidar
    assert results.meta.use_camera
    assert {
        box["sample_token"] for boxes in json.loads(output.read_text())["results"].values() for box in boxes
    } <= set(NuScenes(simulated, "v1.0-mini", {}).scene("scene-0002").tokens)


def test_the_same_command_writes_the_same_file(simulated: Path, tmp_path: Path) -> None:
    contents = []
    for name in ("a.json", "b.json"):
        saga_fg(*arguments(simulated, tmp_path / name), "--split", "all")
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_mistakes_end_in_one_line_and_no_file(simulated: Path, tmp_path: Path) -> None:
    for extra, message in [
        ((), "expected either --split NAME or --scenes A,B"),
        (("--split", "all", "--scenes", "scene-0001"), "expected either --split NAME or --scenes A,B"),
        (("--split", "everything"), "unknown split 'everything'"),
        (("--scenes", "scene-0009"), "unknown scene 'scene-0009'"),
        (("--split", "all", "--detections", "b.json"), "--detections b.json: expected NAME=FILE"),
        (("--split", "all", "--detections", "camera=none.json"), "none.json"),
        (("--split", "all", "--version", "v1.0-none"), "v1.0-none"),
        (("--split", "all", "--config", "none.yaml"), "none.yaml: cannot be read"),
    ]:
        result = saga_fg(*arguments(simulated, tmp_path / "tracks.json"), *extra)
        assert result.exit_code == 2
        assert message in result.stderr
        assert result.stderr.startswith("error: ")
        assert result.stderr.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


def test_a_scene_that_breaks_on_the_way_leaves_the_earlier_result(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "tracks.json"
    output.write_text("earlier")
    calls = []

    def interrupted(self: object, name: str) -> None:
        calls.append(name)
        raise KeyboardInterrupt

    monkeypatch.setattr(NuScenes, "scene", interrupted)
    result = saga_fg(*arguments(simulated, output), "--split", "all")
    assert result.exit_code == 130
    assert calls == ["scene-0001"]
    assert output.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [output]


def test_tables_of_ones_own(tmp_path: Path) -> None:
    for method in METHODS:
        table = tmp_path / "detections.csv"
        rows = [f"{k / 10},car,{k * 0.5},2.0,0.9" for k in range(10)]
        table.write_text("\n".join(["timestamp,label,x,y,score", *rows]) + "\n")
        output = tmp_path / "tracks.csv"
        result = saga_fg("track", "file", table, "--output", output, "--method", method)
        assert result.exit_code == 0, result.output
        late = int(method != "centerpoint")  # the others report from the second detection on
        text = f"{output}: 1 scene, 10 frames, 1 track (1 with a score above 0.5), {10 - late} boxes, "
        assert result.stdout.startswith(text)
        with output.open() as file:
            read = list(csv.DictReader(file))
        assert [float(row["timestamp"]) for row in read] == [k / 10 for k in range(late, 10)]
        assert {row["id"] for row in read} == {"1"}


def test_kitti_recordings(recordings: Path, tmp_path: Path) -> None:
    kitti = recordings / "kitti"
    result = saga_fg(
        "track", "kitti", "--dataroot", kitti, "--detections", kitti / "detections" / "pointrcnn",
        "--sequences", "0000,0017", "--output", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "0000.txt",
        "0017.txt",
        "run.json",
        "tracks.csv",
    ]
    lines = (tmp_path / "out" / "0000.txt").read_text().splitlines()
    assert len(lines) > 100
    assert all(len(line.split()) == 18 for line in lines)


def test_nuscenes_recordings(recordings: Path, tmp_path: Path) -> None:
    nuscenes = recordings / "nuscenes"
    result = saga_fg(
        "track", "nuscenes", "--dataroot", nuscenes, "--version", "v1.0-mini", "--scenes", "scene-0103",
        "--detections", f"lidar={nuscenes / 'detections' / 'centerpoint_lidar.json'}",
        "--detections", f"camera={nuscenes / 'detections' / 'fastbev_camera.json'}",
        "--output", tmp_path / "tracks.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "1 scene, 80 frames" in result.stdout
    assert len(read_tracking_results(tmp_path / "tracks.json").samples) == 40
