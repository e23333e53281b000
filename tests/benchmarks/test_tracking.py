"""The tracking benchmark: variants by named settings, intervals, and the commands from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import tracking
from benchmarks.app import app
from benchmarks.gaps.hidden_recordings import with_made_gaps
from benchmarks.recordings import KittiSet, NuScenesSet, Score, chosen_recordings, simulated_set
from benchmarks.tracking import TrackingBenchSettings, bench_set, graph_differences, verdict
from benchmarks.variants import COMPONENTS, METHODS, changed, variants
from data_tools.metrics import Interval, LabelErrors
from data_tools.simulator import SimulatorSettings
from pipelines.cli import app as product
from pipelines.config import Family, load_config
from pipelines.learning.interactions import LearnedForms
from pipelines.tracking import track_scene
from saga_fg import InputError
from saga_fg.model.edge_rules import Following
from saga_fg.model.learned_interactions import LearnedInteractions

FAMILIES: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "file")
SHORT = replace(SimulatorSettings(), duration=6.0, warm_up=5.0)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_component_is_a_setting_of_every_kind_of_data(family: Family) -> None:
    base = load_config(family)
    for variant in COMPONENTS:
        variant.config(base)
    names = [variant.name for variant in variants(base)]
    assert len(set(names)) == len(names)
    assert names[:3] == ["saga", "kf", "centerpoint"]
    assert all(variant.config(base) != base for variant in variants(base)[3:])
    assert variants(base, components=False) == METHODS


def test_settings_are_changed_by_their_dotted_names() -> None:
    base = load_config("nuscenes")
    every = changed(base, "tracker.classes.*.gate", 0.5)
    assert {each.gate for each in every.tracker.classes.values()} == {0.5}
    one = changed(base, "tracker.classes.car.gate", 0.5)
    assert one.tracker.classes["car"].gate == 0.5
    assert one.tracker.classes["default"] == base.tracker.classes["default"]
    without = next(v for v in COMPONENTS if v.name == "without following").config(load_config("simulated"))
    assert not any(isinstance(edge, Following) for edge in without.tracker.edges)
    for name in ("tracker.nothing", "tracker.classes.plane.gate", "tracker.report_coasting.more"):
        with pytest.raises(InputError, match="expected"):
            changed(base, name, 0.0)


def label_errors(velocity: float) -> LabelErrors:
    n = 5
    column = np.full(n, 1.0)
    fields = {"detection": column, "position": column, "heading": column, "nees": column}
    return LabelErrors(
        np.full(n, "car"), np.arange(n), column, np.ones(n, bool), velocity=np.full(n, velocity), **fields
    )


def test_differences_and_their_verdicts() -> None:
    errors = tuple(label_errors(v) for v in (1.0, 2.0, 3.0))
    better = tuple(label_errors(0.5 * v) for v in (1.0, 2.0, 3.0))
    saga = Score(lambda rows: {"MOTA": 0.5 + 0.01 * sum(rows), "IDS": 2.0 * len(rows)}, better)
    kf = Score(lambda rows: {"MOTA": 0.4 + 0.01 * sum(rows), "IDS": 1.0 * len(rows)}, errors)
    differences = graph_differences(saga, kf, TrackingBenchSettings(draws=20))
    assert differences["MOTA"].estimate == pytest.approx(0.1)
    assert differences["velocity RMSE"].estimate == pytest.approx(-0.5)
    found = {name: verdict(name, each) for name, each in differences.items()}
    assert found["MOTA"] == found["velocity RMSE"] == "better"
    assert found["IDS"] == found["IDS, relative"] == "worse"
    assert differences["IDS, relative"].estimate == pytest.approx(1.0)
    together = replace(saga, cluster=("a", "b", "a"))
    assert together.units == [[0, 2], [1]]
    assert graph_differences(together, kf, TrackingBenchSettings(draws=20))["MOTA"].estimate == pytest.approx(0.1)
    assert found["position RMSE"] == "no difference"
    assert verdict("AMOTP", Interval(-0.1, -0.2, -0.05, 0.95)) == "better"
    assert graph_differences(replace(saga, errors=errors[:1]), kf, TrackingBenchSettings()) == {}


def test_a_set_is_tracked_by_every_variant() -> None:
    settings = TrackingBenchSettings(draws=5)
    result = bench_set(simulated_set(2, settings=replace(SHORT, duration=1.0)), load_config("simulated"), settings)
    assert result.ratio("centerpoint") == 1.0
    assert {"saga", "kf", "centerpoint", "without following"} <= set(result.variants)
    assert set(result.variants["saga"].figures) == {"MOTA", "IDS", "hidden RMSE"}
    assert all(each.milliseconds > 0 for each in result.variants.values())
    assert set(result.variants["saga"].stages) >= {"predict", "associate", "update", "report"}
    assert not result.variants["centerpoint"].stages
    assert len(result.errors("saga")) == len(result.errors("kf"))
    assert "velocity RMSE" in result.differences["saga"]
    assert [len(result.variants[name].predictions) for name in ("saga", "kf", "centerpoint")] == [2, 2, 0]


def test_a_scene_is_tracked_by_what_other_scenes_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learning finds no interactions here: then saga is kf."""

    def learn(recordings, origin, base, progress=None):  # type: ignore[no-untyped-def]
        return LearnedForms(LearnedInteractions(learned_from=" ".join(recordings)), {}, {}, (), {})

    monkeypatch.setattr(tracking, "learn_interactions", learn)
    recordings = simulated_set(3, settings=replace(SHORT, duration=1.0))
    first, second, third = recordings.dataset.scenes
    base = load_config("simulated")
    learned = tracking.learn_by_folds(recordings, base)
    assert {name: found.learned_from for name, found in learned.items()} == {
        first: second,
        second: f"{first} {third}",
        third: second,
    }
    settings = TrackingBenchSettings(components=False, contenders=True, draws=0)
    result = bench_set(recordings, base, settings)
    assert list(result.variants) == ["saga", "kf", "centerpoint", "graph matching", "learned interactions"]
    assert result.variants["learned interactions"].figures == pytest.approx(result.variants["kf"].figures, nan_ok=True)
    with pytest.raises(InputError, match="scenes to learn from beside it"):
        tracking.learn_by_folds(simulated_set(1, settings=SHORT), base)


def test_hota_is_judged_in_the_nuscenes_layout(tmp_path: Path) -> None:
    pytest.importorskip("trackeval")
    root = tmp_path / "nuscenes"
    (tmp_path / "short.yaml").write_text("duration: 3.0\nwarm_up: 5.0\n")
    saga_fg("simulate", "-o", root, "--scenes", "1", "--config", tmp_path / "short.yaml")
    (root / "v1.0-mini" / "splits.json").write_text(json.dumps({"one": ["scene-0001"]}))
    recordings = NuScenesSet("one", root, {"lidar": root / "detections" / "lidar.json"}, "one")
    config = load_config("nuscenes")
    runs = {name: track_scene(recordings.dataset.scene(name), config.new_tracker("kf")) for name in ("scene-0001",)}
    rows = recordings.score(runs).hota()
    assert {(row.label, row.overlap) for row in rows} >= {("car", "2D"), ("car", "3D")}
    assert all(0 <= row.figures.hota <= 1 for row in rows)


def test_hota_of_true_scenes_is_a_headline_figure() -> None:
    pytest.importorskip("trackeval")
    recordings, config = simulated_set(2, settings=replace(SHORT, duration=3.0)), load_config("simulated")
    scenes = recordings.dataset.scenes
    score = recordings.score({n: track_scene(recordings.dataset.scene(n), config.new_tracker("kf")) for n in scenes})
    assert "HOTA car" not in score.figures
    judged = score.with_hota()
    both, first = judged.figures["HOTA car"], judged.figures_of([0])["HOTA car"]
    assert 0 < both < 1
    assert judged.figures_of([0, 0])["HOTA car"] == pytest.approx(first)
    assert judged.with_hota() is judged


def test_recordings_with_made_gaps_are_one_for_intervals(tmp_path: Path) -> None:
    config = load_config("simulated")
    whole = simulated_set(2, settings=replace(SHORT, duration=8.0))
    (one,) = chosen_recordings([whole], ["scene-0002"])
    hidden = with_made_gaps(one, config.sensors, passes=2)
    assert hidden.dataset.scenes == ("scene-0002, pass 1", "scene-0002, pass 2")
    assert hidden.clusters == dict.fromkeys(hidden.dataset.scenes, "scene-0002")
    counts = []
    for scene in (one.dataset.scene("scene-0002"), *map(hidden.dataset.scene, hidden.dataset.scenes)):
        assert scene.name == "scene-0002"
        counts.append(sum(len(frame.detections) for frame in scene.frames))
    assert counts[1] < counts[0]
    assert counts[2] < counts[0]
    runs = {n: track_scene(hidden.dataset.scene(n), config.new_tracker("kf")) for n in hidden.dataset.scenes}
    assert hidden.score(runs).units == [[0, 1]]
    with pytest.raises(InputError, match="expected scenes to learn from beside it"):
        tracking.learn_by_folds(hidden, config)
    kitti = KittiSet.__new__(KittiSet)
    kitti.name = "kitti"
    with pytest.raises(InputError, match="--passes: set kitti: expected simulated or recorded traffic"):
        with_made_gaps(kitti, config.sensors, 1)


def test_recordings_are_chosen_by_name() -> None:
    few, many = simulated_set(2), simulated_set(3)
    (chosen,) = chosen_recordings([few, many], ["scene-0003"])
    assert (chosen.name, chosen.family, chosen.dataset.scenes) == ("simulated", "simulated", ("scene-0003",))
    assert len(chosen_recordings([few, many], ["scene-0001"])) == 2
    with pytest.raises(InputError, match="--test: unknown recording 'scene-0009'"):
        chosen_recordings([few, many], ["scene-0009"])


def saga_fg(*arguments: str | Path, command=product) -> str:
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_commands_on_recordings_in_the_nuscenes_layout(tmp_path: Path) -> None:
    data = tmp_path / "data"
    (tmp_path / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    root = data / "nuscenes"
    data.mkdir()
    saga_fg("simulate", "-o", root, "--scenes", "2", "--config", tmp_path / "short.yaml")
    (root / "detections" / "lidar.json").rename(root / "detections" / "centerpoint_lidar.json")
    splits = root / "v1.0-mini" / "splits.json"
    splits.write_text(json.dumps({"lidar_centerpoint": ["scene-0001", "scene-0002"]}))
    json_file, markdown = tmp_path / "figures.json", tmp_path / "tables.md"
    outputs = ("--json", json_file, "--markdown", markdown)
    printed = saga_fg(
        "tracking", "--data", data, "--sets", "centerpoint", "--no-components", "--draws", "3", *outputs, command=app
    )
    assert "what the graph changes" in printed
    assert "| saga |" in markdown.read_text()
    figures = json.loads(json_file.read_text())["centerpoint"]
    assert set(figures["variants"]) == {"saga", "kf", "centerpoint"}
    assert figures["variants"]["centerpoint"]["ratio_to_centerpoint"] == 1.0
    assert figures["variants"]["saga"]["figures"]["AMOTA"] > 0.2
    assert figures["against_kf"]["saga"]["AMOTA"]["verdict"] in ("better", "worse", "no difference")


def test_mistakes_are_one_line() -> None:
    for arguments, expected in (
        (("--sets", "moon"), "unknown set 'moon'"),
        (("--sets", "kitti"), "expected --data DIR"),
        (("--sets", "simulated", "--lengths", "2"), "--lengths: expected --passes of 1 or more"),
    ):
        result = CliRunner().invoke(app, ["tracking", *arguments])
        assert result.exit_code == 2
        assert expected in result.stderr
