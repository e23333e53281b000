"""Labels from the tracks of other trackers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_file_source import NoScenes
from data_tools.datasets.detection_files import write_tracks
from data_tools.datasets.given_tracks import TrackedRecordings, sensor_names, with_tracks
from data_tools.datasets.kitti.source import KittiSource
from data_tools.datasets.results import SceneResult
from data_tools.metrics import SceneBoxes, scene_metrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import Method, load_config
from pipelines.smoothing import for_given_tracks, load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg import InputError, Scene, Tracks
from tests.data_tools.kitti_example import write_sequence
from tests.pipelines.command import done, refused

OPTIONS = ("simulated", "--scenes", "2", "--seed", "3")


@pytest.fixture(scope="module")
def recording() -> tuple[Scene, tuple[Tracks, ...]]:
    """A simulated scene, and the tracks of greedy nearest centres."""
    scene = SimulatedTraffic(replace(SimulatorSettings(), duration=8.0), scenes=1, seed=3).scene("scene-0001")
    return scene, tracked(scene, "centerpoint")


def tracked(scene: Scene, method: Method) -> tuple[Tracks, ...]:
    return track_scene(scene, load_config("simulated").of_method(method).new_tracker(method)).tracks


@pytest.fixture(scope="module")
def usual(recording: tuple[Scene, tuple[Tracks, ...]]) -> tuple[float, int, int]:
    """Figures of these tracks when they are refined, and how many boxes these have."""
    scene, tracks = recording
    found = refined(scene, given(scene, tracks))
    return *figures(scene, found), sum(map(len, found))


def given(scene: Scene, tracks: tuple[Tracks, ...]) -> SceneResult:
    coasting = np.concatenate([each.coasting for each in tracks])
    return SceneResult(replace(scene, frames=()), SceneBoxes.of_tracks(tracks), coasting=coasting)


def refined(scene: Scene, *results: SceneResult) -> tuple[Tracks, ...]:
    settings = for_given_tracks(load_smooth_config("simulated"), [{scene.name: each} for each in results])
    named = dict(zip(sensor_names(len(results)), results, strict=True))
    return smooth_scene(with_tracks(named, replace(scene, frames=())), settings).tracks


def renamed(result: SceneResult, new: Callable[[str, int], str]) -> SceneResult:
    rows = zip(result.found.id.tolist(), result.found.frame.tolist(), strict=True)
    names = [new(name, frame) for name, frame in rows]
    return replace(result, found=replace(result.found, id=np.array(names)))


def figures(scene: Scene, tracks: tuple[Tracks, ...]) -> tuple[float, int]:
    assert scene.ground_truth is not None
    found = scene_metrics(scene.ground_truth, tracks)
    return found.mota, found.switches


def test_refined_tracks_are_better_than_those_given(
    recording: tuple[Scene, tuple[Tracks, ...]], usual: tuple[float, int, int]
) -> None:
    (before, switched), (after, switches) = figures(*recording), usual[:2]
    assert after > before + 0.02
    assert switches <= switched


def test_fragments_are_joined_and_wrong_joins_are_cut(
    recording: tuple[Scene, tuple[Tracks, ...]], usual: tuple[float, int, int]
) -> None:
    scene, tracks = recording
    result = given(scene, tracks)
    middle = len(scene) // 2
    broken = renamed(result, lambda name, frame: name if frame < middle else f"{name}b")
    ids, count = np.unique(result.found.id, return_counts=True)
    longest = ids[count > 60]
    assert len(longest) > 3
    turn = dict(zip(longest.tolist(), np.roll(longest, 1).tolist(), strict=True))
    crossed = renamed(result, lambda name, frame: turn.get(name, name) if frame >= middle else name)
    for wrong in (broken, crossed):
        mota, switches = figures(scene, refined(scene, wrong))
        assert mota > usual[0] - 0.01
        assert switches <= usual[1] + 1


def test_two_results_become_one_without_objects_twice(
    recording: tuple[Scene, tuple[Tracks, ...]], usual: tuple[float, int, int]
) -> None:
    scene, tracks = recording
    other = tracked(scene, "kf")
    both = refined(scene, given(scene, tracks), given(scene, other))
    assert figures(scene, both)[0] > usual[0] - 0.01
    assert sum(map(len, both)) < 1.2 * usual[2]


def test_what_a_table_marks_as_predicted_and_all_velocities_are_no_evidence(
    recording: tuple[Scene, tuple[Tracks, ...]],
) -> None:
    scene, tracks = recording
    result = given(scene, tracks)
    coasting = np.where(np.arange(len(result.found)) % 3 == 0, 0.4, 0.0)
    scene_with = with_tracks({"tracks": replace(result, coasting=coasting)})
    boxes = [frame.detections.boxes for frame in scene_with.frames]
    assert sum(map(len, boxes)) == int((coasting == 0).sum())
    assert all(np.isnan(each.velocity).all() for each in boxes)
    assert scene_with.ground_truth is None


def test_the_command_refines_a_table_alone_beside_a_dataset_and_in_workers(tmp_path: Path) -> None:
    tracks, short = tmp_path / "theirs.csv", tmp_path / "short.yaml"
    short.write_text("duration: 2.0\nwarm_up: 5.0\n")
    recordings = (*OPTIONS, "--simulator", short)
    for words in (
        ("track", *recordings, "--method", "centerpoint", "--output", tracks),
        ("smooth", *recordings, "--tracks", tracks, "--output", tmp_path / "beside"),
        ("smooth", *recordings, "--tracks", tracks, "--output", tmp_path / "workers", "--workers", "1"),
        ("smooth", "file", "--tracks", tracks, "--output", tmp_path / "alone"),
    ):
        done(*words)
    rows = sum(len(path.read_text().splitlines()) - 1 for path in (tmp_path / "workers" / "labels").iterdir())
    assert rows == len((tmp_path / "beside" / "labels.csv").read_text().splitlines()) - 1
    assert len((tmp_path / "alone" / "labels.csv").read_text().splitlines()) > 100


def test_results_that_cannot_be_refined_are_one_line(
    tmp_path: Path, recording: tuple[Scene, tuple[Tracks, ...]]
) -> None:
    scene, tracks = recording
    empty = tmp_path / "empty.csv"
    write_tracks(empty, [(scene, [each.select(np.empty(0, dtype=int)) for each in tracks])])
    twice = tmp_path / "twice.csv"
    twice.write_text("timestamp,id,label,x,y\n0,7,car,1,2\n0,7,car,9,2\n")
    for files, expected in (
        ((tmp_path / "none.csv",), "none.csv"),
        ((empty,), "expected tracks of the chosen scenes, there are none"),
        ((), "expected one table of detections, or tracks"),
        ((empty, tmp_path / "." / "empty.csv"), "expected each result once"),
        ((twice,), "twice.csv: scene twice: id[1]: expected unique ids"),
    ):
        options = [word for file in files for word in ("--tracks", file)]
        source = OPTIONS if empty in files else ("file",)
        assert expected in refused("smooth", *source, *options, "--output", tmp_path / "labels")
        assert not (tmp_path / "labels").exists()


def test_a_result_is_the_same_sensor_in_every_scene_and_counts_where_it_is(
    recording: tuple[Scene, tuple[Tracks, ...]],
) -> None:
    scene, tracks = recording
    result = given(scene, tracks)
    logits = replace(result, found=replace(result.found, score=4 * result.found.score - 1))
    files = [{"a": result}, {"b": logits}]
    assert [frame.sensor for frame in TrackedRecordings(NoScenes(), files).scene("b").frames][:1] == ["tracks_2"]
    usual = load_smooth_config("kitti")
    found = for_given_tracks(usual, files).sensors
    assert (found["tracks"].score, found["tracks_2"].score) == ("probability", "logit")
    assert found["tracks_2"].noise == usual.sensors["default"].noise


def test_kitti_text_without_scores_is_sure_and_boxes_that_its_table_predicts_are_left_out(tmp_path: Path) -> None:
    source, theirs = KittiSource(dataroot=str(write_sequence(tmp_path)), scenes="0007"), tmp_path / "theirs"
    theirs.mkdir()
    lines = [f"{k} 3 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.5\n" for k in range(3)]
    (theirs / "0007.txt").write_text("".join(lines))
    result = source.read_results(theirs, truth=False).scenes["0007"]
    assert result.found.score.tolist() == [1.0] * 3
    rows = [f"0007,{k / 10},3,car,{k},0,{0.1 * k}" for k in range(3)]
    (theirs / "tracks.csv").write_text("\n".join(["scene,timestamp,id,label,x,y,coasting", *rows]) + "\n")
    result = source.read_results(theirs, truth=False).scenes["0007"]
    assert [len(frame) for frame in with_tracks({"tracks": result}).frames] == [1, 0, 0]
    with pytest.raises(InputError, match="expected a folder with results"):
        source.read_results(theirs / "0007.txt", truth=False)
