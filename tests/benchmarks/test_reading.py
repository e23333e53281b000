"""`bench reading` on small tables: what was generated is what is read, and nothing is kept that is not needed."""

import json
from pathlib import Path

from typer.testing import CliRunner

from benchmarks.app import app
from benchmarks.large_tables import VERSION, TableSize, write_large_tables
from data_tools.datasets.nuscenes import NuScenes


def test_tables_of_any_size_are_tables_of_nuscenes(tmp_path: Path) -> None:
    size = TableSize(scenes=2, samples=3, annotations=5, readings=14, detections=4)
    write_large_tables(tmp_path / "data", size)
    tables = {path.stem: json.loads(path.read_text()) for path in (tmp_path / "data" / VERSION).iterdir()}
    for name in ("sample", "sample_data", "ego_pose", "sample_annotation"):
        assert len(tables[name]) == size.rows[name]
    for name, rows in tables.items():
        assert len({row["token"] for row in rows}) == len(rows), name
        assert {len(row["token"]) for row in rows} == {32}
    dataset = NuScenes(tmp_path / "data", VERSION, {"lidar": tmp_path / "data" / "lidar.json"}, ground_truth=True)
    assert dataset.scenes == ("scene-0001", "scene-0002")
    scene = dataset.scene("scene-0002")
    assert [len(frame) for frame in scene.frames] == [4, 4, 4]
    assert scene.ground_truth is not None
    assert [len(moment) for moment in scene.ground_truth] == [5, 5, 5]
    assert scene.ground_truth[0].id.tolist() == scene.ground_truth[2].id.tolist()


def test_the_command_reads_what_it_wrote(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["reading", "--scenes", "2", "--detections", "3", "--json", str(tmp_path / "figures.json")]
    )
    assert result.exit_code == 0, result.output
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert (figures["scenes"], figures["samples"]) == (2, 80)
    assert figures["annotations"] == figures["rows"]["sample_annotation"] == 2720
    assert figures["detections"] == 240
    assert 0 < figures["start"] <= figures["peak"]
    assert "read 2 scenes, 80 samples, 2720 annotations, 240 detections in " in result.stdout
