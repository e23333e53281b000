from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.nuscenes import ResultMeta, read_tracking_results, write_tracking_results
from saga_fg import Boxes, InputError, Scene, Tracks

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


def test_the_official_layout(tmp_path: Path) -> None:
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


def test_written_and_read_again(tmp_path: Path) -> None:
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


def test_covariances_are_not_required_but_checked(tmp_path: Path) -> None:
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


def test_ids_of_two_scenes_differ(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    write_tracking_results(path, [(scene("x", ["a"]), [tracks()]), (scene("y", ["b"]), [tracks()])], META)
    samples = read_tracking_results(path).samples
    assert samples["a"].id.tolist() == ["x-7"]
    assert samples["b"].id.tolist() == ["y-7"]


def test_unknown_velocity_becomes_zero(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    write_tracking_results(path, [(scene(tokens=["a"]), [tracks(velocity=(np.nan, np.nan))])], META)
    assert read_tracking_results(path).samples["a"].boxes.velocity.tolist() == [[0, 0]]


def test_only_tracking_classes_are_written(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    mixed = tracks((1, 2, 3), ("barrier", "bus", "traffic_cone"), (1, 1, 1))
    write_tracking_results(path, [(scene(tokens=["a"]), [mixed])], META)
    assert read_tracking_results(path).samples["a"].boxes.label.tolist() == ["bus"]


def test_the_best_500_boxes_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    score = np.random.default_rng(0).permutation(600) / 600
    many = tracks(range(600), ["car"] * 600, score)
    write_tracking_results(path, [(scene(tokens=["a"]), [many])], META)
    kept = read_tracking_results(path).samples["a"]
    assert len(kept) == 500
    assert kept.score.min() == 100 / 600


def test_a_track_of_the_format_keeps_its_class(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    write_tracking_results(path, [(scene(), [tracks(), tracks(labels=["bus"])])], META)
    samples = read_tracking_results(path).samples
    assert (samples["a"].id.tolist(), samples["b"].id.tolist()) == (["scene-1-7"], ["scene-1-7-bus"])


def test_tracks_that_cannot_be_written(tmp_path: Path, subtests: pytest.Subtests) -> None:
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


def test_every_sample_needs_a_token(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for tokens in [("", "b"), ("a", "a")]:
        with (
            subtests.test(tokens=tokens),
            pytest.raises(InputError, match="expected a token of its own for every sample"),
        ):
            write_tracking_results(tmp_path / "out.json", [(scene(tokens=tokens), [tracks(), tracks()])], META)


def test_interrupting_leaves_the_earlier_file(tmp_path: Path) -> None:
    def interrupted() -> Iterator[tuple[Scene, list[Tracks]]]:
        yield scene(), [tracks(), tracks()]
        raise KeyboardInterrupt

    path = tmp_path / "out.json"
    path.write_text("earlier")
    with pytest.raises(KeyboardInterrupt):
        write_tracking_results(path, interrupted(), META)
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_broken_tracking_file(tmp_path: Path, subtests: pytest.Subtests) -> None:
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
