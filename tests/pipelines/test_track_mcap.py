"""From a recording of ROS 2 to tracks in it, through the command; results are read by other libraries."""

import json

import pytest

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")

from data_tools.datasets.mcap.dataset import McapRecording
from data_tools.datasets.mcap.source import TOPIC, McapSource
from pipelines.report.page import read_run_record
from tests.data_tools import mcap_example as example
from tests.data_tools.mcap_example import ARRAY, LIDAR, MOMENTS, START, STEP
from tests.pipelines.command import done, refused

LAST = MOMENTS - 1


def messages_of(path):
    """Topic, time and content of all messages, by rosbags."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return [(c.topic, c.msgtype, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


@pytest.fixture
def drive(tmp_path):
    return example.write_mcap(tmp_path / "drive.mcap", example.drive())


def test_autoware_in_and_out(tmp_path, drive):
    done("track", "mcap", drive, "--topic", f"lidar={LIDAR}", "--output", tmp_path / "tracks.mcap")
    found = messages_of(tmp_path / "tracks.mcap")
    assert {(topic, kind) for topic, kind, *_ in found} == {(TOPIC, "autoware_perception_msgs/msg/TrackedObjects")}
    assert [time for _, _, time, _ in found] == [START + k * STEP for k in range(MOMENTS)]
    last = found[-1][3]
    assert last.header.frame_id == "map"
    assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == START + LAST * STEP
    car = next(each for each in last.objects if each.classification[0].label == 1)
    place = car.kinematics.pose_with_covariance.pose.position
    assert [place.x, place.y] == pytest.approx(example.objects(LAST)[0][1][:2], abs=0.1)
    velocity = car.kinematics.twist_with_covariance.twist.linear
    assert [velocity.x, velocity.y] == pytest.approx([8.0, 0.0], abs=0.3)  # along the car
    assert car.shape.dimensions.x == pytest.approx(4.5)
    assert car.object_id.uuid.any()
    P = car.kinematics.pose_with_covariance.covariance.reshape(6, 6)
    assert P[0, 0] > 0


def test_detection_arrays_in_and_out_under_their_own_names(tmp_path):
    path = example.write_bag(tmp_path / "bag", example.drive(example.detection_array, ARRAY, "/objects"))
    names = "CAR=car, PEDESTRIAN=pedestrian, SIGN="
    done("track", "mcap", path, "--classes", names, "--output", tmp_path / "tracks.mcap")
    *_, (topic, kind, _, last) = messages_of(tmp_path / "tracks.mcap")
    assert (topic, kind) == (TOPIC, ARRAY)
    assert {each.results[0].hypothesis.class_id for each in last.detections} == {"CAR", "PEDESTRIAN"}
    assert len({each.id for each in last.detections}) == 2


def test_tracks_in_another_frame_are_shown_in_it_or_refused(tmp_path, drive):
    for suffix in ("mcap", "csv"):
        tracks = tmp_path / f"tracks.{suffix}"
        done("track", "mcap", drive, "--world", "base_link", "--output", tracks)
        page = ("report", "mcap", tracks, "--recording", drive, "--output", tmp_path / "report.html")
        done(*page)  # the record beside the result tells its frame
        record = tmp_path / "tracks.run.json"
        if suffix == "mcap":
            record.unlink()
            said = refused(*page)
            assert "expected tracks in the frame map of the recording, got base_link; add --world base_link" in said
            done(*page, "--world", "base_link")
        else:
            assert McapSource(recording=[str(drive)]).with_kept(read_run_record(tracks).recordings).world == "base_link"


def test_several_recordings_in_parallel_and_again(tmp_path, drive):
    bag = example.write_bag(tmp_path / "bag", example.drive())
    command = ("track", "mcap", drive, bag, "--output", tmp_path / "run", "--workers", 2)
    done(*command)
    assert sorted(path.name for path in (tmp_path / "run" / "tracks").iterdir()) == ["bag.mcap", "drive.mcap"]
    assert "0 done, 2 unchanged" in done(*command).output
    assert "2 done, 0 unchanged" in done(*command, "--world", "base_link").output
    said = refused("track", "mcap", drive, bag, "--output", tmp_path / "tracks.mcap")
    assert "expected one recording; several need --workers" in said


def test_wrong_options(tmp_path, drive):
    for options, message in [
        (("--topic", "lidar="), "expected a topic, or SENSOR=TOPIC"),
        (("--topic", f"a={LIDAR}", "--topic", f"a={LIDAR}"), "the sensor a is given twice"),
    ]:
        assert message in refused("track", "mcap", drive, *options, "--output", tmp_path / "tracks.mcap")


def truth_table(path, shift=0.0):
    """The objects of the drive as a table of truth; y moved by `shift` m."""
    rows = [
        f"{(START + k * STEP) / 1e9!r},{label},{label},{place[0]},{place[1] + shift}"
        for k in range(MOMENTS)
        for label, place, *_ in example.objects(k)
    ]
    path.write_text("\n".join(["time,id,label,x,y", *rows]) + "\n")
    return path


def test_tracks_are_judged_by_a_table_a_file_or_a_topic(tmp_path, drive):
    tracks, figures = tmp_path / "tracks.mcap", tmp_path / "figures.json"
    done("track", "mcap", drive, "--output", tracks)
    table = truth_table(tmp_path / "truth.csv")
    found = {}
    for name, given in {
        "table": ("--truth", table),
        "table and recording": ("--truth", table, "--recording", drive),
        "file": ("--truth", tracks),  # tracks are their own truth
        "topic": ("--truth", TOPIC),
        "tracked anew": ("--truth", table, "--recording", drive),
    }.items():
        result = () if name == "tracked anew" else (tracks,)
        done("evaluate", "mcap", *result, *given, "--json", figures)
        found[name] = json.loads(figures.read_text())["sweep"]["overall"]
    assert found["table"]["recall"] > 0.8
    assert found["table"]["fp"] == 0
    assert found["table and recording"] == found["tracked anew"] == found["table"]
    for own in (found["file"], found["topic"]):
        assert own["recall"] == 1
        assert own["motp"] == pytest.approx(0, abs=1e-9)


def test_a_truth_that_is_not_there_is_named(tmp_path, drive):
    tracks = tmp_path / "tracks.mcap"
    done("track", "mcap", drive, "--output", tracks)
    said = refused("evaluate", "mcap", tracks, "--truth", "/nowhere")
    assert f"expected a topic /nowhere with tracks, there are {TOPIC}" in said
    assert "name it: --truth" in refused("evaluate", "mcap", tracks)


def test_the_page_of_a_recording_shows_the_truth_of_a_table_and_the_recorded_path(tmp_path, drive):
    tracks = tmp_path / "tracks.mcap"
    done("track", "mcap", drive, "--output", tracks)
    source = McapSource(recording=[str(drive)], truth=str(truth_table(tmp_path / "truth.csv")))
    (result,) = source.read_results(tracks).scenes.values()
    recorded = McapRecording(drive).scene("drive")
    assert [len(each) for each in result.scene.ground_truth] == [len(example.objects(k)) for k in range(MOMENTS)]
    assert result.scene.world_T_ego == pytest.approx(recorded.world_T_ego)
    assert len(result.scene.frames) == len(recorded.frames)
