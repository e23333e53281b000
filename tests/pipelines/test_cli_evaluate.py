"""`saga-fg evaluate`: figures of results, as tables and as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from data_tools.datasets.nuscenes import read_scored_scenes
from data_tools.metrics import nuscenes_tracking_metrics
from pipelines.cli import app
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_random_drive import VERSION, write_random_drive


def evaluate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random drive in the nuScenes layout, with tracks in result.json."""
    root = tmp_path_factory.mktemp("random") / "drive"
    write_random_drive(root, seed=0)
    return root


def test_nuscenes_figures_are_those_of_the_metrics(drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    (tmp_path / "plots").mkdir()
    (tmp_path / "plots" / "calibration.png").write_text("of an earlier run")
    result = evaluate(
        "nuscenes",
        drive / "result.json",
        "--dataroot",
        drive,
        "--split",
        "drive",
        "--json",
        file,
        "--plots",
        tmp_path / "plots",
    )
    assert result.exit_code == 0, result.output
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"recall.png", "errors.png"}
    metrics = nuscenes_tracking_metrics(
        [each.tracking for each in read_scored_scenes(drive / "result.json", drive, VERSION).values()]
    )
    figures = json.loads(file.read_text())
    assert figures["scenes"] == ["scene-0", "scene-1"]
    assert figures["overall"]["amota"] == metrics.overall.amota
    assert figures["per_class"]["car"]["ids"] == metrics.per_class["car"].ids
    assert figures["per_class"]["trailer"]["amota"] is None  # there is none
    row = next(line for line in result.stdout.splitlines() if "overall" in line)
    assert f"{metrics.overall.amota:.3f}" in row
    assert f"{metrics.overall.amotp:.3f}" in row


def test_some_scenes_alone(drive: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, "--scenes", "scene-1", "--json", file)
    assert result.exit_code == 0, result.output
    assert json.loads(file.read_text())["scenes"] == ["scene-1"]


def test_mistakes_are_one_line(drive: Path) -> None:
    for arguments, expected in [
        (("--split", "drive", "--scenes", "scene-0"), "either --split NAME or --scenes"),
        ((), "either --split NAME or --scenes"),
        (("--split", "dribe"), "did you mean 'drive'"),
        (("--split", "drive", "--json", "/nowhere/f.json"), "not writable"),
    ]:
        result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, *arguments)
        assert result.exit_code == 2
        assert expected in result.stderr
        assert len(result.stderr.splitlines()) == 1


def test_a_result_that_lacks_a_sample_is_refused(drive: Path, tmp_path: Path) -> None:
    content = json.loads((drive / "result.json").read_text())
    del content["results"]["scene-0-3"]
    (tmp_path / "short.json").write_text(json.dumps(content))
    result = evaluate("nuscenes", tmp_path / "short.json", "--dataroot", drive, "--split", "drive")
    assert result.exit_code == 2
    assert "scene-0-3 is missing" in result.stderr


def test_nuscenes_hota_and_errors_on_the_labels_that_detections_match(tmp_path: Path) -> None:
    pytest.importorskip("trackeval")
    data, tracks, file = tmp_path / "data", tmp_path / "tracks.json", tmp_path / "figures.json"
    (tmp_path / "short.yaml").write_text("duration: 6.0\nwarm_up: 5.0\n")
    lidar = f"lidar={data / 'detections' / 'lidar.json'}"
    of_data = ("--dataroot", data, "--split", "all", "--detections", lidar)
    for command in (
        ("simulate", "-o", data, "--scenes", "1", "--config", tmp_path / "short.yaml"),
        ("track", "nuscenes", *of_data, "-o", tracks, "--explain"),
        ("evaluate", "nuscenes", tracks, *of_data, "--hota", "--innovations", "--json", file),
    ):
        result = CliRunner().invoke(app, [str(argument) for argument in command])
        assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    overall = figures["errors"]["overall"]
    assert 0 < overall["tracked"] <= overall["labels"]
    assert 0 < overall["position"] < 1
    assert 0 < overall["detection"] < 1
    assert 0 < figures["calibration"]["overall"]["coverage"]["0.9"] <= 1
    assert 0 < figures["tracks"]["overall"]["true"] < figures["tracks"]["overall"]["tracks"]
    assert 0 < figures["tracks"]["car"]["rank_quality"] <= 1
    assert "Whole tracks" in result.stdout
    assert figures["hota"]["car"]["2D"]["hota"] >= figures["hota"]["car"]["3D"]["hota"] > 0.2
    assert "HOTA, CLEAR and Identity" in result.stdout
    assert figures["innovations"]["car"]["matches"] > 20


def test_kitti_labels_as_results_are_perfect(tmp_path: Path) -> None:
    root, results, file = write_sequence(tmp_path / "kitti"), tmp_path / "results", tmp_path / "figures.json"
    results.mkdir()
    labels = (root / "training" / "label_02" / "0007.txt").read_text().splitlines()
    (results / "0007.txt").write_text("".join(f"{line} 0.9\n" for line in labels if "DontCare" not in line))
    result = evaluate("kitti", results, "--dataroot", root, "--iou", "0.5,0.7", "--json", file)
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    assert figures["sequences"] == ["0007"]
    assert set(figures["per_class"]) == {"car"}  # a sitting person is none that counts
    assert set(figures["per_class"]["car"]) == {"0.5", "0.7"}
    assert figures["per_class"]["car"]["0.7"]["mota"] == 1.0
    assert figures["errors"]["car"]["position"] == 0.0
    assert figures["errors"]["car"]["velocity"] is None
    assert figures["tracks"]["car"]["ghost_share"] == 0.0
    assert figures["tracks"]["car"]["rank_quality"] == 1.0
    assert figures["calibration"]["car"]["boxes"] == 0
    assert "Calibration" not in result.stdout


def test_innovations_need_a_journal(drive: Path) -> None:
    result = evaluate("nuscenes", drive / "result.json", "--dataroot", drive, "--split", "drive", "--innovations")
    assert result.exit_code == 2
    assert "track with --explain" in result.stderr


def test_who_sits_is_unknown_to_the_usual_evaluation(tmp_path: Path) -> None:
    for option, false_positives in [([], 1), (["--persons", "exempt"], 0)]:
        folder = tmp_path / str(false_positives)
        root, results, file = write_sequence(folder / "kitti"), folder / "results", folder / "figures.json"
        results.mkdir()
        labels = root / "training" / "label_02" / "0007.txt"
        sitting = "2 5 Person 0 0 0 700 150 720 250 1.2 0.5 0.6 -3 1.6 8 0"
        standing = "2 6 Pedestrian 0 0 0 800 150 820 250 1.8 0.5 0.6 3 1.6 8 0"
        labels.write_text(f"{sitting}\n{standing}\n")
        found = (line.replace("Person ", "Pedestrian ") for line in (sitting, standing))
        (results / "0007.txt").write_text("".join(f"{line} 0.9\n" for line in found))
        result = evaluate("kitti", results, "--dataroot", root, "--iou", "0.5", "--json", file, *option)
        assert result.exit_code == 0, result.output
        assert json.loads(file.read_text())["per_class"]["pedestrian"]["0.5"]["fp"] == false_positives


def test_persons_are_false_or_exempt(tmp_path: Path) -> None:
    result = evaluate("kitti", tmp_path, "--dataroot", tmp_path, "--persons", "sitting")
    assert result.exit_code == 2
    assert "--persons: expected false or exempt, got 'sitting'" in result.stderr


def test_overlaps_that_are_none(tmp_path: Path) -> None:
    for iou in ["half", "0", "1.5", ","]:
        result = evaluate("kitti", tmp_path, "--dataroot", tmp_path, "--iou", iou)
        assert result.exit_code == 2
        assert "--iou: expected" in result.stderr


def test_simulated_scenes_are_judged_at_every_moment(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    (tmp_path / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    arguments = ("--scenes", "1", "--seed", "3", "--simulator", tmp_path / "short.yaml", "--method", "kf")
    result = evaluate("simulated", *arguments, "--json", file)
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    overall = figures["tracking"]["overall"]
    assert overall["objects"] > 100
    assert overall["objects"] == sum(f["objects"] for name, f in figures["tracking"].items() if name != "overall")
    assert overall["objects"] == figures["errors"]["overall"]["labels"]
    assert 0 < overall["position_rmse"] < 1
    assert 0 < figures["tracks"]["overall"]["rank_quality"] <= 1
    assert figures["calibration"]["overall"]["boxes"] > 50
    assert figures["innovations"]["car"]["matches"] > 50
    assert 0.2 < figures["innovations"]["car"]["nis"] < 5
