"""`saga-fg track`: results, settings, options, doubts, files by their address."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from data_tools.datasets.kitti import local_kitti
from data_tools.datasets.kitti.source import KittiSource
from data_tools.datasets.nuscenes import NuScenes, read_tracking_results
from data_tools.datasets.source import opened_recording
from data_tools.files.file_access import local_tree
from data_tools.simulator import SimulatorSettings
from pipelines.checks import Checks
from pipelines.config import Family, TrackConfig, load_config
from pipelines.configuration import read_settings, write_settings
from pipelines.configuration.reading import settings_of
from saga_fg import Curvilinear, InputError, Tracker, TrackerSettings
from saga_fg.model.map_rules import InLane
from saga_fg.providers import Gps, Landmarks, Odometry, StartSettings
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.traffic import TrafficSettings
from saga_fg.types.road_map import Lane, RoadMap
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, write_results, write_tables
from tests.pipelines.command import done, refused, saga_fg

METHODS = ("saga", "kf", "centerpoint")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    done("simulate", "-o", folder / "data", "--scenes", "2", "--seed", "3", "--config", folder / "short.yaml")
    return folder / "data"


def arguments(simulated: Path, output: Path) -> list[str | Path]:
    detections = f"lidar={simulated / 'detections' / 'lidar.json'}"
    return ["track", "nuscenes", "--dataroot", simulated, "--detections", detections, "--output", output]


@pytest.mark.parametrize("method", ["saga", "centerpoint"])
def test_nuscenes_results_list_every_sample_of_the_split(simulated, tmp_path, method):
    output = tmp_path / "tracks.json"
    result = done(*arguments(simulated, output), "--split", "all", "--method", method)
    assert result.stdout.startswith(f"{output}: 2 scenes, 16 frames, ")
    assert result.stdout.rstrip().endswith("frames/s")
    assert re.search(r", \d+ tracks \(\d+ with a score above 0\.5\), ", result.stdout)
    results = read_tracking_results(output)
    dataset = NuScenes(simulated, "v1.0-mini", {})
    assert set(results.samples) == {token for name in dataset.scenes for token in dataset.scene(name).tokens}
    assert sum(len(boxes) for boxes in results.samples.values()) > 20
    assert results.meta.use_lidar
    assert not results.meta.use_camera


def test_two_sensors_and_chosen_scenes(simulated, tmp_path):
    output = tmp_path / "tracks.json"
    camera = f"camera={simulated / 'detections' / 'camera.json'}"
    done(*arguments(simulated, output), "--detections", camera, "--scenes", "scene-0002")
    results = read_tracking_results(output)
    assert results.meta.use_lidar
    assert results.meta.use_camera
    assert {
        box["sample_token"] for boxes in json.loads(output.read_text())["results"].values() for box in boxes
    } <= set(NuScenes(simulated, "v1.0-mini", {}).scene("scene-0002").tokens)


def test_mistakes_end_in_one_line_and_no_file(simulated, tmp_path):
    for extra, message in [
        ((), "expected either --split NAME or --scenes A,B"),
        (("--split", "all", "--scenes", "scene-0001"), "expected either --split NAME or --scenes A,B"),
        (("--split", "everything"), "unknown split 'everything'"),
    ]:
        said = refused(*arguments(simulated, tmp_path / "tracks.json"), *extra)
        assert message in said
        assert said.startswith("error: ")
        assert said.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


def test_a_scene_that_breaks_on_the_way_leaves_the_earlier_result(simulated, tmp_path, monkeypatch):
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


# The shipped configuration: every kind of data has one, each is valid, and users' files lie over it


def test_shipped_defaults_are_valid_and_survive_the_round_trip():
    for family in get_args(Family):
        config = load_config(family)
        assert read_settings(TrackConfig, write_settings(config)) == config


def test_every_setting_explains_itself():
    for settings in [TrackConfig, SimulatorSettings]:

        def unexplained(cls: type, where: str) -> list[str]:
            found = [f"{where}.{item.name}" for item in settings_of(cls) if not item.comment]
            for item in settings_of(cls):
                schema = item.schema
                while not hasattr(schema, "classes") and (hasattr(schema, "value") or hasattr(schema, "items")):
                    schema = schema.value if hasattr(schema, "value") else schema.items[0]
                for below in getattr(schema, "classes", ()):
                    found += unexplained(below, f"{where}.{item.name}")
            return found

        assert unexplained(settings, settings.__name__) == []


PROVIDERS = """
tracker:
  estimator: isam2
  providers:
    - {kind: "saga_fg.providers:Odometry", start: {place: [1, 2, 0.1], deviation: 0.3}}
    - {kind: "saga_fg.providers:Gps", deviation: 0.5}
    - saga_fg.providers:Landmarks
"""


def test_providers_have_settings_of_their_own():
    config = read_settings(TrackConfig, PROVIDERS)
    start = StartSettings(place=(1.0, 2.0, 0.1), deviation=0.3)
    assert config.tracker.providers == (Odometry(start), Gps(deviation=0.5), "saga_fg.providers:Landmarks")
    assert read_settings(TrackConfig, write_settings(config)) == config
    assert Tracker(config.tracker).providers == (Odometry(start), Gps(deviation=0.5), Landmarks())


def test_settings_of_providers_that_make_no_sense():
    for provider, message in [
        ('{kind: "saga_fg.providers:Gps", deviation: -1}', r"providers\[0\]: deviation: expected a finite number > 0"),
        ('{kind: "saga_fg.providers:Gps", deviaton: 1}', r"providers\[0\].deviaton: unknown key, did you mean"),
        ('{kind: "saga_fg.providers:Gps", deviation: far}', r"providers\[0\].deviation: expected a number, got"),
        ('{kind: "saga_fg.providers:Odometry", start: {place: [0, 0]}}', r"start.place: expected a list of 3"),
        ("{deviation: 1}", r"providers\[0\].kind: expected MODULE:NAME, the key is missing"),
        ('{kind: "math:sqrt"}', r"providers\[0\]: cannot be made without arguments: TypeError"),
        ('{kind: "math:sqrt", x: 1}', r"providers\[0\].kind: math:sqrt: expected a dataclass"),
        ('{kind: "no_such_module:X"}', r"providers\[0\].kind: .*no_such_module cannot be imported"),
        ("3", r"providers\[0\]: expected a section \(key: value\), got 3"),
    ]:
        with pytest.raises(InputError, match=message):
            read_settings(TrackConfig, f"tracker: {{estimator: isam2, providers: [{provider}]}}")


# Options of `saga-fg track` that contradict each other or would destroy the input are refused


def test_options_that_contradict_each_other_or_would_destroy_the_input_are_refused(tmp_path):
    detections, output = tmp_path / "detections.csv", tmp_path / "tracks.csv"
    for x, arguments, message in [
        (1.0, ("--method", "centerpoint", "--estimator", "isam2"), "has no estimator"),
        (1.0, ("--method", "centerpoint", "--association", "graph"), "has its own"),
        (1.0, ("--lag", "1"), "goes with --estimator fixed-lag"),
        (1.0, ("--estimator", "kalman", "--lag", "1"), "goes with --estimator fixed-lag"),
        (1.0, ("--output", detections), "another file"),
        (1e200, (), "within 1e+09"),
    ]:
        rows = f"timestamp,x,y\n0.0,{x},2.0\n0.1,1.5,2.0\n"
        detections.write_text(rows)
        assert message in refused("track", "file", detections, "--output", output, *arguments)
        assert not output.exists()
        assert detections.read_text() == rows


def test_the_way_of_matching_is_an_option(tmp_path):
    """Two cars cross at one place: told to take the nearest pair first, the tracker does something else."""
    detections = tmp_path / "detections.csv"
    detections.write_text("timestamp,x,y\n0.0,0.0,0.0\n0.0,3.0,0.0\n0.5,2.0,0.0\n0.5,6.0,0.0\n")
    tracks = {}
    for method in ("hungarian", "greedy", "graph"):
        output = tmp_path / f"{method}.csv"
        done("track", "file", detections, "--output", output, "--association", method)
        tracks[method] = output.read_text()
    assert tracks["graph"] == tracks["hungarian"] != tracks["greedy"]


# Warnings of settings that have no effect: those of another estimator, and lanes that nothing reads

ROAD = RoadMap(lanes=(Lane("lane", ((0.0, 0.0), (50.0, 0.0))),))
FOLLOWS = {"car": ClassSettings(Curvilinear(course_time=0.7))}


def said(caplog, method="saga", **tracker):
    config = TrackConfig(tracker=replace(TrackerSettings(), **{"road_map": ROAD, **tracker}))
    caplog.clear()
    checks = Checks(config.of_method(method))
    checks.finish()
    checks.finish()
    return [each.getMessage() for each in caplog.records if "lanes" in each.getMessage()]


def test_lanes_that_nothing_reads_are_said_once_and_others_are_not_doubted(caplog):
    (message,) = said(caplog)
    assert "tracker.road_map.lanes: no class follows them (motion.course_time)" in message
    assert len(said(caplog, classes=FOLLOWS, traffic=TrafficSettings(reach=0.0))) == 1
    for tracker in [{"classes": FOLLOWS}, {"edges": (InLane(),)}, {"road_map": None}]:
        assert said(caplog, **tracker) == []
    assert said(caplog, method="kf") == []


def said_of(caplog, **tracker):
    caplog.clear()
    usual = TrackConfig()
    Checks(replace(usual, tracker=TrackerSettings(**tracker)), usual)
    return [each.getMessage() for each in caplog.records]


def test_a_setting_without_effect_is_said_once_and_those_that_act_are_not_doubted(caplog):
    for tracker, named in [
        ({"estimator": "isam2", "lag": 5.0}, "lag: 5"),
        ({"estimator": "kalman", "lag": 5.0}, "lag: 5"),
        ({"estimator": "isam2", "tolerance": 0.5, "max_component": 1}, "tolerance: 0.5, max_component: 1"),
        ({"estimator": "fixed-lag", "max_component": 32}, "max_component: 32"),
    ]:
        (message,) = said_of(caplog, **tracker)
        assert message.startswith(f"tracker: {named}: without effect with estimator: {tracker['estimator']}")
    for tracker in [
        {"estimator": "isam2"},
        {"estimator": "isam2", "tolerance": 0.0, "max_component": 10_000},  # exact, as asked for
        {"estimator": "fixed-lag", "lag": 5.0},
        {"estimator": "kalman", "tolerance": 0.5, "max_component": 1},
    ]:
        assert said_of(caplog, **tracker) == []


def test_shipped_settings_are_not_doubted(caplog):
    for family in ["nuscenes", "kitti", "file"]:
        Checks(load_config(family), load_config("file"))
        assert [each for each in caplog.records if "without effect" in each.getMessage()] == []


# nuScenes and KITTI by URL: the same results as from the folders they are copies of

Put = Callable[[Path, str], str]


@pytest.fixture
def put() -> Iterator[Put]:
    """Copies a local folder to a URL in memory."""
    memory = pytest.importorskip("fsspec", reason="fsspec is not installed (extra [remote])").filesystem("memory")

    def copy(folder: Path, name: str) -> str:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                memory.pipe_file(f"/{name}/{path.relative_to(folder)}", path.read_bytes())
        return f"memory://{name}"

    yield copy
    memory.store.clear()


def test_nuscenes(tmp_path, put):
    root = write_tables(tmp_path / "nuscenes")
    write_results(root / "lidar.json")
    url = put(root, "bucket/nuscenes")
    command = ["track", "nuscenes", "--scenes", "scene-0103", "--version", VERSION]
    for output, place, detections in (
        ("a.json", root, f"lidar={root}/lidar.json"),
        ("b.json", url, f"lidar={url}/lidar.json"),
        ("c.json", url, f"{url}/lidar.json"),
    ):
        done(*command, "--dataroot", place, "--detections", detections, "-o", tmp_path / output)
        assert (tmp_path / output).read_bytes() == (tmp_path / "a.json").read_bytes()


def test_kitti(tmp_path, put):
    root = write_sequence(tmp_path / "kitti")
    url = put(root, "bucket/kitti")
    for place, output in ((root, "here"), (url, "there")):
        arguments = ("--dataroot", place, "--detections", f"{place}/found", "-o", tmp_path / output)
        done("smooth", "kitti", *arguments)
    for file in ("labels.csv", "label_02/0007.txt"):
        assert (tmp_path / "here" / file).read_bytes() == (tmp_path / "there" / file).read_bytes()


def test_a_worker_fetches_its_sequence_alone(tmp_path, put):
    root = write_sequence(write_sequence(tmp_path / "kitti", "0007"), "0008")
    url = put(root, "kitti")
    with local_kitti(url, f"{url}/found", ["0008"]) as dataset:
        assert dataset.scenes == ("0008",)
        assert [path.name for path in dataset.files("0008")[0].parent.iterdir()] == ["0008.txt"]
    with opened_recording(KittiSource(dataroot=url, detections=f"{url}/found", scenes="0007"), "0007") as there:
        digests = there.digests
    local = KittiSource(dataroot=str(root), detections=str(root / "found"), scenes="0007")
    with opened_recording(local, "0007") as here:
        assert digests == here.digests


def test_errors_name_the_url(tmp_path, put):
    root = write_sequence(tmp_path / "kitti")
    (root / "training" / "oxts" / "0007.txt").write_text("nonsense\n")
    url = put(root, "kitti")
    said = refused("track", "kitti", "--dataroot", url, "--detections", f"{url}/found", "-o", tmp_path / "out")
    assert said.startswith("error: memory://kitti/training/oxts/0007.txt: line 1: ")
    with pytest.raises(InputError, match="expected GPS/IMU records"), local_kitti("memory://nothing", "memory://none"):
        pass
    with pytest.raises(InputError, match="memory://kitti: here"), local_tree(url, ["*"]) as folder:
        raise InputError(f"{folder}: here")
