"""Labels of long recordings in chunks, and with providers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.detection_files import read_detections, read_scenes_in_parts, read_tracks
from pipelines.cli import app
from pipelines.smoothing import load_smooth_config, smooth_scene, smooth_stream
from saga_fg import Detections, Frame, InputError
from saga_fg.smoothing import ChunkSettings
from saga_fg.smoothing.labelling import Identities, ObjectSummary, median_sizes
from saga_fg.smoothing.recording import Backlog, TrackedFrame
from tests.pipelines.command import done

HEADER = "timestamp,label,x,y,length,width,height,yaw,score"


def drive(seconds: float = 18.0, rate: float = 4.0) -> list[str]:
    """A queue of three cars, the middle one hidden for 2.5 s; a parked one; one that comes late; boxes seen askew."""
    rng = np.random.default_rng(3)
    rows = []
    for k in range(round(seconds * rate)):
        t = k / rate
        cars = [(8 * t - 12 * n + 2 * np.sin(t / 3), 0.0, 4.5 + 0.2 * n) for n in range(3)]
        cars += [(30.0, 8.0, 4.0)] + [(100 - 6 * t, -6.0, 5.0)] * (t > 9)
        for n, (x, y, length) in enumerate(cars):
            if n == 1 and 10 < t < 12.5:
                continue
            dx, dy, dl = rng.normal(0, [0.2, 0.2, 0.1])
            yaw = np.pi * ((n == 4) ^ (rng.random() < 0.3))
            rows.append(f"{t:.3f},car,{x + dx:.4f},{y + dy:.4f},{length + dl:.3f},1.8,1.5,{yaw:.3f},0.8")
    return rows


def write(path: Path, rows: list[str], header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_chunks_come_to_what_the_whole_comes_to(tmp_path):
    path, config = write(tmp_path / "drive.csv", drive()), load_smooth_config("file")
    whole = smooth_scene(read_detections(path).scene("drive"), config)
    (run,) = smooth_stream(
        read_scenes_in_parts(path, 60), config, tmp_path, chunks=ChunkSettings(length=5.0, margin=6.0)
    )
    assert len(list(tmp_path.glob("000000/*.npz"))) == 3  # it was cut
    assert run.frames == whole.frames
    assert replace(run.counts, joined=0) == replace(whole.counts, joined=0)
    moments = run.labels
    assert len(moments) == len(whole.labels)
    for mine, theirs in zip(moments, whole.labels, strict=True):
        a, b = mine.tracks, theirs.tracks
        assert a.timestamp == b.timestamp
        assert a.id.tolist() == b.id.tolist()
        moves = np.abs(b.boxes.position[:, 1] - 8.0) > 1.0
        np.testing.assert_allclose(a.boxes.position[moves], b.boxes.position[moves], atol=1e-3)
        np.testing.assert_allclose(a.boxes.position, b.boxes.position, atol=0.05)  # parked: averaged over less
        np.testing.assert_allclose(a.boxes.size, b.boxes.size, atol=1e-3)
        np.testing.assert_allclose(np.cos(a.boxes.yaw - b.boxes.yaw), 1.0, atol=1e-3)
        np.testing.assert_allclose(a.position_covariance[moves], b.position_covariance[moves], rtol=1e-2)
        np.testing.assert_allclose(a.score, b.score, atol=1e-9)
        assert mine.source.tolist() == theirs.source.tolist()
        assert mine.quality.tolist() == theirs.quality.tolist()


@pytest.mark.parametrize("pause", ["frames without detections", "no frames", "no frames for years"])
def test_chunks_in_which_nothing_is_seen(tmp_path, pause):
    later = 1e8 if pause == "no frames for years" else 100.0
    rows = [f"{t},car,5,5,4,2,1.5,0,0.8" for t in (*np.arange(0, 4, 0.5), *np.arange(later, later + 4, 0.5))]
    if pause == "frames without detections":
        rows[8:8] = [f"{t},,,,,,,," for t in np.arange(4, later, 0.5)]
    path = write(tmp_path / "yard.csv", rows)
    (run,) = smooth_stream(
        read_scenes_in_parts(path, 5), load_smooth_config("file"), tmp_path, chunks=ChunkSettings(5.0, 6.0)
    )
    moments = run.tracks
    seen = [len(tracks) for tracks in moments if tracks.timestamp < 4 or tracks.timestamp >= later]
    assert seen == [1] * 16
    assert len(moments) == len(np.unique([row.split(",")[0] for row in rows]))


def test_the_command_streams_several_recordings(tmp_path):
    rows = [f"{name},{row}" for name in ("a", "b") for row in drive(6.0)]
    path = write(tmp_path / "two.csv", rows, f"scene,{HEADER}")
    done("smooth", "file", path, "--output", tmp_path / "out")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "labels.csv",
        "review.csv",
        "run.json",
        "summary.json",
    }
    labels = read_tracks(tmp_path / "out" / "labels.csv")
    first, second = (labels.boxes.position[labels.scene == name] for name in ("a", "b"))
    np.testing.assert_array_equal(first, second)


def test_parts_hold_together_what_belongs_together(tmp_path):
    path = write(tmp_path / "drive.csv", drive(6.0))
    whole, parts = read_detections(path).scene("drive"), list(read_scenes_in_parts(path, 10))
    assert len(parts) > 5
    assert np.concatenate([part.timestamps for part in parts]).tolist() == whole.timestamps.tolist()
    assert [len(frame) for part in parts for frame in part.frames] == [len(frame) for frame in whole.frames]
    scattered = ["a,0,car,0,0,,,,,1", "b,0,car,0,0,,,,,1", "a,1,car,0,0,,,,,1"]
    with pytest.raises(InputError, match="scene a: expected its rows together, it goes on after b"):
        list(read_scenes_in_parts(write(tmp_path / "s.csv", scattered, f"scene,{HEADER}"), 1))
    late = ["1,car,0,0,,,,,1", "0,car,0,0,,,,,1"]
    with pytest.raises(InputError, match="line 3: timestamp: expected rows in order of time"):
        list(read_scenes_in_parts(write(tmp_path / "l.csv", late), 1))
    with pytest.raises(InputError, match="unknown scene 'c'"):
        list(read_scenes_in_parts(path, scenes=["c"]))


def test_poses_are_given_in_all_parts_or_in_none(tmp_path):
    rows = ["0,car,5,0,1,2,0.1", "1,car,6,0,,,"]
    path = write(tmp_path / "poses.csv", rows, "timestamp,label,x,y,ego_x,ego_y,ego_yaw")
    with pytest.raises(InputError, match="line 3: ego_x, ego_y, ego_yaw: expected in all rows or in none"):
        list(read_scenes_in_parts(path, 1))


def backlog(detections: int, seconds: int, settings: ChunkSettings) -> Backlog:
    """A frame a second with so many detections each."""
    backlog, nothing = Backlog(settings), Frame(0.0, "lidar", Detections.empty())
    times = np.arange(float(seconds))
    backlog.want(times)
    backlog.extend([TrackedFrame(time, nothing, np.full(detections, -1)) for time in times.tolist()])
    return backlog


@pytest.mark.parametrize(("detections", "ends"), [(1, [20, 40]), (10, [9, 18, 27, 36]), (1000, [5, 10, 15])])
def test_crowds_are_cut_into_shorter_chunks(detections, ends):
    settings = ChunkSettings(length=20.0, margin=5.0, detections=100)
    known = backlog(detections, 60, settings)
    spans = []
    for begin, end in known.chunks(until=59.0):
        frames, wanted = known.around(begin, end)
        assert [frame.time for frame in frames] == wanted.tolist()
        assert wanted[0] == max(0.0, begin - 5.0)
        assert wanted[-1] == end + 4.0
        spans.append((begin, end))
    assert [end for _, end in spans][: len(ends)] == ends
    assert [begin for begin, _ in spans[1:]] == [end for _, end in spans[:-1]]
    (last,) = list(known.chunks(until=np.inf))[-1:]
    assert last[1] == np.inf


def test_an_object_keeps_its_name_from_chunk_to_chunk():
    identities = Identities()
    track_of = np.array([1, 1, 2, 2, 3])
    times = np.array([0.0, 1.0, 2.0, 9.0, 9.5])
    one_and_two = np.array([1, 1, 1, 1, 3])
    names = identities.name(np.array([1, 3]), one_and_two, track_of, times, (0.0, 10.0))
    assert names == {1: 1, 3: 3}
    assert identities.joined == 1
    late = slice(3, None)  # the next chunk sees the second tracklet alone
    names = identities.name(np.array([2, 3]), track_of[late], track_of[late], times[late], (10.0, 20.0))
    assert names == {2: 1, 3: 3}
    other = np.array([-1, -1, 0, 0, 3])  # or takes it for the end of another, which begins at the edge of what it sees
    again = identities.name(np.array([0, 3]), other, np.array([1, 1, 0, 2, 3]), times, (10.0, 20.0))
    assert again == {0: 1, 3: 3}
    identities.forget(before=20.0)
    names = identities.name(np.array([2]), track_of[2:4], track_of[2:4], times[2:4], (30.0, 40.0))
    assert names == {2: 2}


def test_objects_that_were_one_have_names_of_their_own_when_they_part():
    identities, track_of, times = Identities(), np.array([9, 2]), np.array([0.0, 9.0])
    together = identities.name(np.array([9]), np.array([9, 9]), track_of, times, (0.0, 10.0))
    assert together == {9: 9}
    apart = identities.name(np.array([2, 9]), track_of, track_of, times, (10.0, 20.0))
    assert apart == {2: 9, 9: 2}


def test_what_lasts_of_an_object_is_gathered_over_its_chunks():
    summary = ObjectSummary()
    for size, probability in ((4.0, 0.9), (4.2, 0.5), (9.0, 0.1)):
        for height in (np.nan, 1.5):
            summary.add_detections(probability, np.array([[size, 2.0, height]]), np.array([probability]))
    summary.add_headings(summary.heading_sign(0.1), yaw=0.1, path=-3.0, votes=3.0)
    assert summary.heading_sign(0.2) == 1
    turned = summary.heading_sign(0.1 - np.pi)  # the next chunk sees it the other way round
    assert turned == -1
    summary.add_headings(turned, yaw=0.1 - np.pi, path=12.0, votes=1.0)
    size = median_sizes([summary])[0]
    assert 4.0 < size[0] < 4.1  # the far guess of 9 m does not count for more than its weight
    assert size[1:] == pytest.approx([2.0, 1.5])
    assert (summary.probability, summary.detections) == (pytest.approx(3.0), 6)
    assert summary.path == -15.0  # against the direction of its start
    summary.close()
    np.testing.assert_array_equal(median_sizes([summary])[0], size)
    summary.add_detections(0.9, np.array([[5.0, 2.0, 1.5]]), np.array([0.9]))  # it appears again
    assert size[0] < median_sizes([summary])[0, 0] < 4.5


def test_many_values_are_kept_by_their_weights():
    rng = np.random.default_rng(0)
    sizes = rng.normal([4.5, 1.8, 1.5], 0.1, (20_000, 3))
    summary = ObjectSummary()
    for part in np.split(sizes, 20):
        summary.add_detections(1000.0, part, np.ones(1000))
    np.testing.assert_allclose(median_sizes([summary])[0], np.median(sizes, axis=0), atol=1e-3)


# Factor providers of users' own in `saga-fg smooth`: named in the configuration, or given from Python

MODULE = """
from functools import partial

import numpy as np

from factors import ResidualFactors
from saga_fg.graph import OBJECT, Additions


def crowded(origin, x):  # a wall at y = 4
    return np.logaddexp(0.0, (x[:, 1:2] + origin[1] - 3.5) / 0.1)


class Wall:
    name = "wall"

    def factors(self, view):
        rows = [[one.key] for one in view.now(OBJECT).values() if one.label == "pedestrian"]
        return Additions(factors=[ResidualFactors(rows, (4,), partial(crowded, view.origin), 0.01 * np.eye(1))])


class Broken:
    name = "broken"

    def factors(self, view):
        raise ValueError("no wall is known")
"""


@pytest.fixture
def walkers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pedestrian on his way to a wall, beside the module that knows of it."""
    (tmp_path / "walls_of_this_test.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    rng = np.random.default_rng(0)
    rows = [
        f"drive,{0.25 * k},pedestrian,{0.1 * k + rng.normal(0, 0.05):.4f},{2 + 0.02 * k + rng.normal(0, 0.05):.4f},0.9"
        for k in range(72)
    ]
    path = tmp_path / "walkers.csv"
    path.write_text("\n".join(["scene,timestamp,label,x,y,score", *rows]) + "\n")
    return path


def configuration(folder: Path, provider: str) -> Path:
    path = folder / f"{provider}.yaml"
    path.write_text(f"smoothing:\n  providers: ['walls_of_this_test:{provider}']\n")
    return path


def test_a_wall_of_the_configuration_moves_the_labels(walkers):
    arguments = ["smooth", "file", str(walkers), "-o"]
    for more in ([], ["--config", str(configuration(walkers.parent, "Wall"))]):
        done(*arguments, walkers.parent / f"labels{len(more)}", *more)
    plain, walled = (
        read_tracks(walkers.parent / folder / "labels.csv").boxes.position for folder in ("labels0", "labels2")
    )
    assert len(plain) == len(walled) == 72
    assert np.allclose(plain[0], walled[0], atol=1e-3)
    assert walled[-1, 1] < plain[-1, 1] - 0.02

    run = CliRunner().invoke(
        app, [*arguments, str(walkers.parent / "broken"), "--config", str(configuration(walkers.parent, "Broken"))]
    )
    assert run.exit_code != 0
    assert "provider broken: no wall is known" in run.output


def test_in_chunks_and_from_python_it_is_the_same(walkers):
    from walls_of_this_test import Wall  # type: ignore[import-not-found]

    config = load_smooth_config("file", configuration(walkers.parent, "Wall"))
    parts = read_scenes_in_parts(walkers, 20)
    (run,) = smooth_stream(parts, config, walkers.parent, chunks=ChunkSettings(length=5.0, margin=5.0))
    streamed = run.tracks
    scene = read_detections(walkers).scene("drive")
    for whole in (smooth_scene(scene, config), smooth_scene(scene, load_smooth_config("file"), providers=[Wall()])):
        assert len(list(walkers.parent.glob("000000/*.npz"))) > 1
        assert len(streamed) == len(whole.tracks)
        for mine, theirs in zip(streamed, whole.tracks, strict=True):
            assert mine.id.tolist() == theirs.id.tolist()
            np.testing.assert_allclose(mine.boxes.position, theirs.boxes.position, atol=2e-3)
