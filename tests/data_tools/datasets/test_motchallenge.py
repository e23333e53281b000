"""Sequences of MOTChallenge, and the camera above the ground: boxes to places and back, results, mistakes."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_tools.conformance import check_dataset
from data_tools.datasets.motchallenge import ImageRows, MotChallengeSource
from data_tools.metrics.hota import image_overlaps
from saga_fg import Boxes, Detections, GroundCamera, IdentityTracker, InputError
from tests.pipelines.command import done, refused

CAMERA = GroundCamera(focal_length=1200.0, height=6.0, pitch=0.25)
SIZE, FRAMES, PEOPLE = (0.6, 0.6, 1.8), 30, 6
ANGLE = st.floats(-0.3, 0.3)
CAMERAS = st.builds(
    GroundCamera,
    focal_length=st.floats(500, 3000),
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    height=st.floats(2, 30),
    yaw=st.floats(-3, 3),
    pitch=st.floats(0.05, 1.4),
    roll=ANGLE,
)


def people(time):
    """Boxes of people who walk on parallel lines, m."""
    places = [(15.0 + 5 * k, -6.0 + 2.5 * k + (-1) ** k * 1.2 * time, SIZE[2] / 2) for k in range(PEOPLE)]
    return Boxes.of(["pedestrian"] * PEOPLE, np.array(places), np.tile(SIZE, (PEOPLE, 1)))


@given(camera=CAMERAS, ahead=st.floats(5, 60), aside=st.floats(-10, 10))
@settings(max_examples=60, deadline=None)
def test_what_stands_on_the_ground_is_found_where_it_stands(camera, ahead, aside):
    turn = np.array([[np.cos(camera.yaw), -np.sin(camera.yaw)], [np.sin(camera.yaw), np.cos(camera.yaw)]])
    place = turn @ [ahead, aside] + [camera.x, camera.y]
    boxes = Boxes.of(["car"], [[*place, 0.75]], [[1.8, 1.8, 1.5]])
    found, rows = camera.detections(camera.image_boxes(boxes), np.ones(1), np.array(["car"]))
    assert rows.tolist() == [0]
    assert found.boxes.position == pytest.approx(boxes.position, abs=1e-6)
    assert found.boxes.size == pytest.approx(boxes.size, abs=1e-6)
    by_homography = GroundCamera(homography=tuple(map(tuple, (-2 * camera.ground_H_image).tolist())))
    if camera.roll == 0:
        assert by_homography.detections(camera.image_boxes(boxes), np.ones(1), np.array(["car"]))[
            0
        ].boxes.position == pytest.approx(boxes.position, abs=1e-6)


def test_the_covariance_is_that_of_scattered_foot_points():
    rng, foot = np.random.default_rng(0), np.array([900.0, 620.0])
    box = np.array([[foot[0] - 20, foot[1] - 100, foot[0] + 20, foot[1]]])
    found, _ = CAMERA.detections(box, np.ones(1), np.array(["pedestrian"]))
    places, _ = CAMERA.places(foot + rng.normal(0, 0.05 * 100, (20000, 2)))
    assert np.cov(places.T) == pytest.approx(found.position_covariance[0], rel=0.15, abs=0.02)
    step = 1e-4
    ahead, back = (CAMERA.places(foot + d * step * np.eye(2))[0] for d in (1, -1))
    assert CAMERA.places(foot[None])[1][0] == pytest.approx(((ahead - back) / (2 * step)).T, rel=1e-6)


def test_the_sky_is_no_place():
    boxes = np.array([[900.0, 50.0, 950.0, 100.0], [900.0, 500.0, 950.0, 700.0]])
    found, rows = CAMERA.detections(boxes, np.ones(2), np.array(["a", "b"]))
    assert rows.tolist() == [1]
    assert found.boxes.label.tolist() == ["b"]
    behind = Boxes.of(["a"], [[-30.0, 0.0, 1.0]], [[1.0, 1.0, 2.0]])
    assert np.isnan(CAMERA.image_boxes(behind)).all()


def test_overlaps_in_the_image():
    a, b = (
        np.array([[0.0, 0.0, 2.0, 2.0]]),
        np.array([[1.0, 0.0, 3.0, 2.0], [0.0, 0.0, 2.0, 2.0], [5.0, 5.0, 6.0, 6.0]]),
    )
    assert image_overlaps(a, b)[0] == pytest.approx([1 / 3, 1.0, 0.0])


@pytest.fixture
def sequences(tmp_path):
    """Two sequences with noise of boxes, detections in nine of ten frames; and the file of the camera."""
    rng = np.random.default_rng(0)
    for name in ("SEQ-01", "SEQ-02"):
        folder = tmp_path / "train" / name
        (folder / "det").mkdir(parents=True)
        (folder / "gt").mkdir()
        (folder / "seqinfo.ini").write_text(f"[Sequence]\nname={name}\nframeRate=10\nseqLength={FRAMES}\n")
        found, true = [], ["1,99,10,10,20,40,0,12,1.0"]
        for frame in range(FRAMES):
            for k, (left, top, right, low) in enumerate(CAMERA.image_boxes(people(frame / 10)).tolist()):
                true.append(f"{frame + 1},{k + 1},{left:.3f},{top:.3f},{right - left:.3f},{low - top:.3f},1,1,1.0")
                if rng.random() < 0.9:
                    x, y = rng.normal(0, 0.03, 2) * (low - top)
                    found.append(
                        f"{frame + 1},-1,{left + x:.2f},{top + y:.2f},{right - left:.2f},{low - top:.2f},0.9,-1,-1,-1"
                    )
        (folder / "det" / "det.txt").write_text("\n".join(found) + "\n")
        (folder / "gt" / "gt.txt").write_text("\n".join(true) + "\n")
    (tmp_path / "camera.yaml").write_text("focal_length: 1200\nheight: 6\npitch: 0.25\n")
    return tmp_path / "train"


def test_it_is_tracked_judged_and_written_in_its_own_format(sequences, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    camera = ("--camera", "camera.yaml")
    check_dataset(MotChallengeSource(folder=str(sequences), camera=CAMERA))
    done("track", "motchallenge", sequences, *camera, "-o", "results")
    done("track", "motchallenge", sequences, *camera, "-o", "run", "--workers", "2")
    for name in ("SEQ-01", "SEQ-02"):
        assert (tmp_path / "run/tracks" / f"{name}.txt").read_text() == (
            tmp_path / "results" / f"{name}.txt"
        ).read_text()
    rows = ImageRows.read(tmp_path / "results/SEQ-01.txt")
    assert len(set(rows.id.tolist())) == PEOPLE
    assert rows.frame.max() == FRAMES - 1
    dataset = MotChallengeSource(folder=str(sequences), camera=CAMERA)
    evaluation = dataset.read_results(tmp_path / "results").evaluate()
    assert evaluation.figures()["tracking"]["overall"]["mota"] > 0.9
    assert evaluation.figures()["tracking"]["overall"]["objects"] == 2 * FRAMES * PEOPLE, "class 12 does not count"
    pytest.importorskip("trackeval", reason="HOTA comes with the extra eval")
    hota = evaluation.figures()["hota"]["pedestrian"]["image"]
    assert hota.ids == 0
    assert hota.mota > 0.9
    done("evaluate", "motchallenge", "results", "--folder", sequences, *camera, "--scenes", "SEQ-02")


def test_the_truth_as_a_result_is_perfect_in_the_image(sequences, tmp_path):
    pytest.importorskip("trackeval", reason="HOTA comes with the extra eval")
    lines = [line.split(",") for line in (sequences / "SEQ-01/gt/gt.txt").read_text().splitlines()[1:]]
    (tmp_path / "perfect").mkdir()
    text = "".join(",".join([*line[:6], "1.0", "-1,-1,-1"]) + "\n" for line in lines)
    (tmp_path / "perfect" / "SEQ-01.txt").write_text(text)
    results = MotChallengeSource(folder=str(sequences), camera=CAMERA).read_results(tmp_path / "perfect")
    hota = results.evaluate().figures()["hota"]["pedestrian"]["image"]
    assert (hota.hota, hota.mota, hota.idf1) == pytest.approx((1.0, 1.0, 1.0))


def test_mistakes_are_one_line(sequences, tmp_path, subtests):
    detections, facts = sequences / "SEQ-01/det/det.txt", sequences / "SEQ-01/seqinfo.ini"
    command = ("track", "motchallenge", sequences, "--camera", tmp_path / "camera.yaml", "-o", tmp_path / "out")
    for path, text, message in (
        (detections, "1,-1,2,3\n", f"{detections}: expected rows of at least 7 numbers with commas"),
        (detections, "1,-1,a,3,4,5,6\n", f"{detections}: expected rows of at least 7 numbers"),
        (detections, "1,-1,2,3,4,5,.9\n0,-1,2,3,4,5,.9\n", f"{detections}: row 2: expected a whole frame from 1 on"),
        (detections, "1,-1,2,3,-4,5,.9\n", f"{detections}: row 1: expected a whole frame from 1 on"),
        (detections, "1e9,-1,2,3,4,5,.9\n", f"{detections}: row 1: expected a whole frame from 1 on"),
        (detections, "# no numbers\n", f"{detections}: expected rows of at least 7 numbers"),
        (tmp_path / "camera.yaml", "x: 1e300\n", "expected a camera that sees the ground"),
        (facts, "frameRate=3\n", f"{facts}: expected frameRate and seqLength of a [Sequence]"),
        (facts, "[Sequence]\nframeRate=0\nseqLength=3\n", f"{facts}: expected numbers from 1e-06 to 1e+06"),
        (tmp_path / "camera.yaml", "height: -1\n", "height: expected a finite number > 0"),
        (
            tmp_path / "camera.yaml",
            "homography: [[1, 0, 0], [0, 1, 0], [0, 0, 0]]\n",
            "expected a camera that sees the ground",
        ),
    ):
        with subtests.test(message):
            before = path.read_text()
            path.write_text(text)
            assert message in refused(*command)
            assert not (tmp_path / "out").exists()
            path.write_text(before)
    assert "expected sequences with det/det.txt" in refused("track", "motchallenge", tmp_path, *command[3:])


def test_boxes_above_the_horizon_are_told_and_left_out(sequences, caplog):
    detections, source = sequences / "SEQ-01/det/det.txt", MotChallengeSource(folder=str(sequences), camera=CAMERA)

    def found():
        with source.open() as dataset:
            return sum(map(len, dataset.scene("SEQ-01").frames))

    count = found()
    assert not caplog.records
    rows = len(detections.read_text().splitlines())
    detections.write_text(detections.read_text() + "1,-1,900,-9000,40,20,0.9,-1,-1,-1\n")
    assert found() == count
    assert f"1 of {rows + 1} boxes left out: they end above the horizon" in caplog.text


def test_detections_are_numbered_as_by_other_trackers():
    tracker, seen = IdentityTracker(CAMERA, frame_rate=10.0, classes={0: "pedestrian"}), []
    for k in range(10):
        xyxy = CAMERA.image_boxes(people(k / 10))[:: 1 if k % 2 else -1]
        found = SimpleNamespace(xyxy=xyxy, confidence=np.full(PEOPLE, 0.9), class_id=np.zeros(PEOPLE, int), mask=None)
        numbered = tracker.update(found)
        assert numbered is not found
        assert not hasattr(found, "tracker_id")
        assert numbered.xyxy is xyxy
        seen.append(numbered.tracker_id[:: 1 if k % 2 else -1].tolist())
    assert seen[0] == [-1] * PEOPLE
    assert len(set(map(tuple, seen[1:]))) == 1
    assert len(set(seen[-1])) == PEOPLE
    assert tracker.update(SimpleNamespace(xyxy=np.empty((0, 4)))).tracker_id.shape == (0,)


def test_detections_in_the_world_are_numbered_too():
    tracker = IdentityTracker(frame_rate=10.0)
    for k in range(5):
        found = tracker.update(Detections(people(k / 10), np.full(PEOPLE, 0.9)))
    assert sorted(found.identity.tolist()) == list(range(1, PEOPLE + 1))
    with pytest.raises(InputError, match=r"expected saga_fg\.Detections, as there is no camera, got SimpleNamespace"):
        tracker.update(SimpleNamespace(xyxy=np.zeros((1, 4))))
    with pytest.raises(InputError, match=r"xyxy\[0\]: expected left < right and top < bottom"):
        IdentityTracker(CAMERA).update(SimpleNamespace(xyxy=np.zeros((1, 4))))
    for wrong, message in (
        ({"xyxy": np.zeros(4)}, r"xyxy: expected shape"),
        ({"class_id": ["person"]}, r"class_id: expected numbers"),
        ({"class_id": [0, 1]}, r"class_id: expected shape \(1,\)"),
        ({"confidence": []}, r"confidence: expected shape \(1,\)"),
    ):
        with pytest.raises(InputError, match=message):
            IdentityTracker(CAMERA).update(SimpleNamespace(**{"xyxy": np.array([[0.0, 0, 9, 9]])} | wrong))
    with pytest.raises(InputError, match="frame_rate: expected a number > 0"):
        IdentityTracker(CAMERA, frame_rate=0)
