"""Each finding: data that raise it, and data like it that must not."""

import numpy as np

from data_tools.datasets.detection_files import TableImport
from saga_fg import Boxes, Detections, Frame
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.tables.conventions import (
    Sample,
    camera_axes,
    findings_of,
    fitting_convention,
    frame_taken_for_another,
    headings_in_degrees,
)
from saga_fg.tables.plausibility import (
    far_too_fast,
    idle_rules,
    length_below_width,
    repeated_rows,
    scores_beyond_one,
    settings_without_data,
    strange_time_steps,
    unlikely_sizes,
    usual_class,
    usual_classes,
    within_a_metre,
)
from saga_fg.tables.velocities import velocities_against_motion, velocities_between_frames
from saga_fg.types.dataset import Finding, Mend

RNG = np.random.default_rng(5)
CARS = np.full(60, "car")


def option(finding: Finding | None) -> str | None:
    if finding is None:
        return None
    (judged,) = TableImport().judged([finding], {"length": "len", "width": "wid"})
    return judged.option


def test_headings_in_degrees(subtests):
    for yaw, found in [
        (RNG.uniform(0, 360, 60), "--units angle=deg"),
        (RNG.uniform(-180, 180, 60), "--units angle=deg"),
        (np.r_[np.full(50, np.nan), RNG.uniform(0, 360, 30)], "--units angle=deg"),
        (RNG.uniform(-np.pi, np.pi, 60), None),
        (RNG.uniform(0, 2 * np.pi, 60), None),
        (np.r_[RNG.uniform(-3, 3, 99), 7.0], None),  # one that was not wrapped
        (np.full(60, np.nan), None),
        (np.array([90.0]), None),  # too few to tell
    ]:
        with subtests.test(yaw=yaw, found=found):
            assert option(headings_in_degrees(yaw)) == found
            of_vehicle = found and found.replace("angle", "ego_yaw")
            assert option(headings_in_degrees(yaw, "ego_yaw")) == of_vehicle


def test_headings_against_motion(subtests):
    direction = RNG.uniform(-np.pi, np.pi, 100)
    speed = np.where(np.arange(100) < 80, 5.0, 0.0)
    velocity = speed[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    moving = direction + RNG.normal(0, 0.1, 100)
    turned = np.where(RNG.random(100) < 0.1, moving + np.pi, moving)
    along_x = np.where(np.arange(100) % 2, 0.0, np.pi) + RNG.normal(0, 0.05, 100)
    on_x = 5.0 * np.column_stack([np.cos(along_x), np.sin(along_x)])
    walks = np.zeros(100, dtype=np.bool_)
    for name, yaw, v, found in [
        ("right", moving, velocity, "rad"),
        ("some turned round", turned, velocity, "rad"),
        ("some turned round on a road along x", np.where(RNG.random(100) < 0.3, along_x + np.pi, along_x), on_x, None),
        ("mirrored", -moving, velocity, "clockwise"),
        ("degrees", np.degrees(moving), velocity, "deg"),
        ("mirrored degrees", -np.degrees(moving), velocity, "clockwise_deg"),
        ("compass", 90 - np.degrees(moving), velocity, "compass"),
        ("compass in rad", np.pi / 2 - moving, velocity, "compass_rad"),
        ("compass on a straight road", 90 - np.degrees(along_x), on_x, "compass"),
        ("mirrored, which makes no difference", -along_x, on_x, "rad"),
        ("no convention", RNG.uniform(-3, 3, 100), velocity, ""),
        ("constant", np.zeros(100), velocity, ""),
        ("all turned round", moving + np.pi, velocity, ""),
        ("nothing moves", -moving, 0.1 * velocity, None),
        ("no velocities", -moving, np.full((100, 2), np.nan), None),
        ("too few", -moving[:30], velocity[:30], None),
    ]:
        with subtests.test(name):
            fit = fitting_convention(yaw, v, walks[: len(yaw)])
            assert (None if fit is None else fit[0]) == found
    walking = 0.2 * velocity
    assert fitting_convention(-moving, walking, walks) is None
    for yaw, unit in ((-moving, "clockwise"), (RNG.uniform(-3, 3, 100), None), (np.zeros(100), "")):
        fit = fitting_convention(yaw, walking, ~walks)  # people look around
        assert (None if fit is None else fit[0]) == unit


def test_units_that_mend_are_those_of_how_a_table_is_read():
    finding = Finding("headings", "", "", Mend(units={"angle": "clockwise"}))
    for how, names, option in [
        (TableImport(), {}, "--units angle=clockwise"),
        (TableImport(units={"angle": "deg"}), {}, "--units angle=clockwise_deg"),
        (TableImport(), {"yaw": "heading_deg"}, "--units angle=clockwise_deg"),
    ]:
        (judged,) = how.judged([finding], names)
        assert judged.option == option
        assert judged.stops
    (again,) = TableImport(units={"angle": "clockwise"}).judged([finding], {})
    assert not again.stops  # the option that mends it is there
    of_column = TableImport(units={"yaw": "deg"})
    assert of_column.unit("yaw", None) == "deg"
    assert of_column.unit("ego_yaw", None) is None


def test_units_that_are_given_win_over_the_size_of_numbers(subtests):
    frame = np.repeat(np.arange(20), 5)
    for finding, given in [
        (strange_time_steps(np.arange(60) * 30.0, np.full(60, "lidar")), {"time": "s"}),
        (headings_in_degrees(np.linspace(0, 40, 60)), {"angle": "rad"}),
        (headings_in_degrees(np.linspace(0, 40, 60), "ego_yaw"), {"ego_yaw": "rad"}),
        (within_a_metre(frame, np.add(RNG.uniform(0, 0.1, (100, 3)), [48.1, 11.6, 0.0])), {"length": "m"}),
    ]:
        assert finding is not None
        with subtests.test(finding.kind):
            assert [one.stops for one in TableImport().judged([finding], {})] == [True]
            assert [one.stops for one in TableImport(units=given).judged([finding], {})] == [False]
            assert [one.stops for one in TableImport(units={"score": "percent"}).judged([finding], {})] == [True]


def test_measured_velocities_against_motion(subtests):
    motion = RNG.normal(0, 6, (80, 2))
    for factor, found in [(1.0, None), (3.6, "km/h"), (2.237, "mph"), (3.281, "ft/s"), (0.5, None), (-3.6, None)]:
        with subtests.test(factor=factor):
            measured = factor * motion + RNG.normal(0, 0.3, motion.shape)
            finding = velocities_against_motion(measured, motion + RNG.normal(0, 0.5, motion.shape))
            assert option(finding) == (None if found is None else f"--units speed={found}")
    for factor in (1 / 3.6, 1 / 2.237):
        finding = velocities_against_motion(factor * motion + RNG.normal(0, 0.1, motion.shape), motion)
        assert option(finding) == "--columns vx=,vy="
        for how, names in [(TableImport(units={"speed": "km/h"}), {}), (TableImport(), {"vx": "vx_kmh"})]:
            (judged,) = how.judged([finding], names)
            assert judged.option == "--units speed=m/s"
            assert judged.stops
        (judged,) = TableImport(columns={"vx": "", "vy": ""}).judged([finding], {})
        assert not judged.stops
    assert option(velocities_against_motion(0 * motion, motion)) == "--columns vx=,vy="
    slow = np.concatenate([np.zeros((600, 2)), np.tile([1.3, 0.0], (200, 1))])  # who walks past parked cars
    walked, measured = (slow + RNG.normal(0, 0.3, slow.shape) for _ in range(2))
    assert option(velocities_against_motion(3.6 * measured, walked)) == "--units speed=km/h"
    assert velocities_against_motion(measured, walked) is None
    assert velocities_against_motion(3.6 * motion[:20], motion[:20]) is None
    assert velocities_against_motion(3.6 * motion, np.full(motion.shape, np.nan)) is None


def test_camera_axes(subtests):
    right, ahead = RNG.uniform(-12, 12, 80), RNG.uniform(4, 50, 80)
    down = RNG.normal(1.2, 0.3, 80)
    for name, position, found in [
        ("camera", (right, down, ahead), True),
        ("vehicle", (ahead, right, -down), False),
        ("world on a hill", (right, 3 * right, ahead), False),
        ("a straight road in the mountains", (right, down, ahead + 200), False),
        ("on a plane", (ahead, 0 * down, down), False),
    ]:
        with subtests.test(name):
            finding = camera_axes(np.column_stack(position))
            assert option(finding) == ("--coordinates camera" if found else None)
    assert camera_axes(np.column_stack((right, down, ahead))[:10]) is None


def test_velocities_between_frames_are_those_of_objects_that_cannot_be_mistaken():
    v = np.array([[8.0, 0.0], [0.0, 5.0], [-3.0, 1.0]])
    start = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 60.0]])
    time, label = np.repeat(np.arange(5) * 0.2, 3), np.tile(["car", "car", "truck"], 5)
    place = np.concatenate([start + t * v for t in np.arange(5) * 0.2])
    found = velocities_between_frames(time, label, place)
    np.testing.assert_allclose(found[:6], np.tile(v, (2, 1)), atol=1e-9)
    assert np.isnan(found[6:]).all()  # followed for less than half a second
    crowd = np.concatenate([0.3 * np.arange(3)[:, None] * [1.0, 0.0] + t for t in np.arange(5) * 0.2])
    assert np.isnan(velocities_between_frames(time, np.full(15, "car"), crowd)).all()
    at_once = velocities_between_frames(np.array([0.0, 0.0, 1e-308, 1e-308]), np.full(4, "car"), place[[0, 1, 3, 4]])
    assert np.isnan(at_once).all()


def test_scores_beyond_one(subtests):
    for score, what in [
        (RNG.uniform(5, 99, 60), "percent"),
        (RNG.normal(0, 4, 60), "logits"),
        (RNG.uniform(0, 1, 60), None),
        (np.ones(60), None),
        (np.full(5, 90.0), None),
    ]:
        with subtests.test(what):
            finding = scores_beyond_one(score)
            assert (finding is None) == (what is None)
            assert finding is None or f"look like {what}" in finding.what


def test_repeated_rows():
    frame, score = np.arange(60) // 6, RNG.uniform(0, 1, 60)
    boxes = Boxes.of(CARS, RNG.normal(0, 9, (60, 3)))
    assert repeated_rows(frame, boxes, score) is None
    twice = np.r_[0:60, 0:30]
    found = repeated_rows(frame[twice], boxes.select(twice), score[twice])
    assert found is not None
    assert found.what.startswith("30 of the first 90 detections are repeated")
    assert repeated_rows(frame[twice], boxes.select(twice), RNG.uniform(0, 1, 90)) is None, "as of two detectors"


def test_length_below_width(subtests):
    for label, size, found in [
        ("car", (1.9, 4.5, 1.6), True),
        ("REGULAR_VEHICLE", (1.9, 4.5, 1.6), True),
        ("car", (4.5, 1.9, 1.6), False),
        ("pedestrian", (0.6, 0.8, 1.7), False),
        ("barrier", (0.5, 2.6, 1.0), False),  # these are wider than long
        ("car", (np.nan, np.nan, np.nan), False),
    ]:
        with subtests.test(label=label, size=size, found=found):
            finding = length_below_width(np.full(60, label), np.tile(size, (60, 1)))
            assert option(finding) == ("--columns length=wid,width=len" if found else None)


def test_unlikely_sizes(subtests):
    for label, size, unit in [
        ("car", (4500.0, 1900.0, 1600.0), "mm"),
        ("car", (450.0, 190.0, 160.0), "cm"),
        ("car", (0.0045, 0.0019, 0.0016), "km"),
        ("car", (15.0, 6.2, 5.0), "ft"),
        ("car", (4.5, 1.9, 1.6), None),
        ("truck", (16.0, 2.6, 3.5), None),
        ("pedestrian", (0.5, 0.5, 1.7), None),
        ("tram", (40.0, 2.6, 3.5), None),
        ("ship", (120.0, 20.0, 30.0), None),
        ("pedestrian", (50.0, 50.0, 170.0), "cm"),
    ]:
        with subtests.test(label=label, size=size, unit=unit):
            found = option(unlikely_sizes(np.full(60, label), np.tile(size, (60, 1))))
            assert found == (None if unit is None else f"--units length={unit}")


def test_within_a_metre():
    frame = np.repeat(np.arange(20), 5)
    position = RNG.uniform(0, 100, (100, 3))
    assert within_a_metre(frame, position) is None
    finding = within_a_metre(frame, position / 1000)
    assert finding is not None
    assert "look like km" in finding.what
    degrees = within_a_metre(frame, position / 1000 + [48.1, 11.6, 0.0])
    assert degrees is not None
    assert "degrees of latitude" in degrees.what
    assert option(degrees) == "--columns x=...,y=..."
    lonely = np.zeros((100, 3)) + RNG.normal(0, 0.1, (100, 3))
    assert within_a_metre(np.arange(100), lonely) is None  # one parked object


def test_far_too_fast(subtests):
    for label, speed, found in [
        ("car", 100.0, True),
        ("pedestrian", 15.0, True),
        ("car", 45.0, False),
        ("pedestrian", 2.0, False),
        ("drone", 90.0, False),
    ]:
        with subtests.test(label=label, speed=speed, found=found):
            velocity = np.column_stack([np.full(60, speed), np.zeros(60)])
            assert option(far_too_fast(np.full(60, label), velocity)) == ("--units speed=km/h" if found else None)
            velocity[3:] = 1.0  # a few strange ones are no rule
            assert far_too_fast(np.full(60, label), velocity) is None


def test_strange_time_steps(subtests):
    for step, found in [
        (100.0, "ms"),
        (5e5, "ms"),
        (1e5, "us"),
        (1e8, "ns"),
        (0.1, None),
        (0.4, None),
        (2.0, None),
        (10.0, None),
    ]:
        with subtests.test(step=step, found=found):
            finding = strange_time_steps(np.arange(20) * step, np.full(20, "lidar"))
            assert (finding is None) == (found is None)
            if step != 5e5:
                assert finding is None or option(finding) == f"--units time={found}"


def test_a_long_pause_is_no_strange_step():
    time = np.r_[np.arange(20) * 0.1, 500 + np.arange(20) * 0.1]
    assert strange_time_steps(time, np.full(40, "lidar")) is None
    finding = strange_time_steps(np.arange(20) * 1e-5, np.full(20, "lidar"))
    assert finding is not None
    assert "coarser unit" in finding.what


def drive(coordinates: str, start: float, speed: float = 10.0, traffic: float = 0.0) -> list[Frame]:
    """A vehicle that passes standing objects, and traffic; boxes given in coordinates, all called world."""
    place = RNG.uniform([start - 20, -20], [start + 60, 20], (30, 2))
    frames = []
    for k in range(30):
        pose = yaw_transform(start + speed * k / 10, 3.0, 0.0, 0.1)
        at = place + np.array([traffic * k / 10, 0.0])
        if coordinates == "ego":
            at = (at - pose[:2, 3]) @ pose[:2, :2]
        boxes = Boxes.of(["car"] * 30, np.column_stack([at + RNG.normal(0, 0.1, at.shape), np.zeros(30)]))
        frames.append(Frame(k / 10, "lidar", Detections(boxes, np.full(30, 0.9)), pose))
    return frames


def test_ego_taken_for_world(subtests):
    for frames, found in [
        (drive("ego", 0.0), True),  # it moves with the vehicle
        (drive("ego", 3000.0, 0.0), True),  # it stands far away from all of it
        (drive("world", 0.0), False),
        (drive("world", 3000.0), False),
        (drive("world", 0.0, traffic=12.0), False),
        (drive("world", 0.0, traffic=10.0), False),  # all go along with the vehicle
        (drive("ego", 0.0, 0.0), False),  # nothing tells
    ]:
        with subtests.test(frames=frames, found=found):
            s = Sample.from_frames(frames)
            finding = frame_taken_for_another(s)
            assert option(finding) == ("--coordinates ego" if found else None)


def test_a_sample_has_all_doubts_and_none_where_scores_are_declared():
    frames = drive("world", 0.0)
    assert findings_of(Sample.from_frames(frames)) == []
    logits = [Frame(f.timestamp, "lidar", Detections(f.detections.boxes, np.full(30, -2.0))) for f in frames]
    assert [finding.kind for finding in findings_of(Sample.from_frames(logits))] == ["scores"]
    assert findings_of(Sample.from_frames(logits), lambda sensor: sensor == "lidar") == []
    assert findings_of(Sample.from_frames([])) == []


def test_names_of_classes(subtests):
    for name, ours in [
        ("REGULAR_VEHICLE", "car"),
        ("LARGE_VEHICLE", "truck"),
        ("BOX_TRUCK", "truck"),
        ("VEHICULAR_TRAILER", "trailer"),
        ("vehicle.bus.rigid", "bus"),
        ("human.pedestrian.adult", "pedestrian"),
        ("Cyclist", "bicycle"),
        ("MotorCycle", "motorcycle"),
        ("RegularVehicle", "car"),
        ("passenger_car", "car"),
        ("CAR", "car"),
        ("person_sitting", "pedestrian"),
        ("dog", None),
        ("carton", None),
    ]:
        with subtests.test(name=name, ours=ours):
            assert usual_class(name) == ours


def test_rules_that_meet_no_class():
    finding = idle_rules({"car", "pedestrian"}, {"REGULAR_VEHICLE", "PERSON", "dog"})
    assert finding is not None
    assert option(finding) == "--classes PERSON=pedestrian,REGULAR_VEHICLE=car"
    numbered = idle_rules({"car", "pedestrian"}, {"0", "1"})  # 1 may be the pedestrians
    assert option(numbered) == "--classes 0=...,1=..."
    assert numbered is not None
    (judged,) = TableImport().judged([numbered], {})
    assert str(judged).endswith("; fill in and add --classes 0=...,1=...")
    assert not judged.stops  # objects can be tracked one by one
    assert idle_rules({"car"}, {"car", "dog"}) is None
    assert idle_rules(set(), {"dog"}) is None
    assert idle_rules({"car"}, set()) is None
    assert usual_classes(["car", "Van", "dog"], {"car"}) == {"Van": "car"}


def test_settings_without_data():
    finding = settings_without_data("tracker.classes", {"Pedestrian", "car"}, {"pedestrian", "car"})
    assert finding is not None
    assert str(finding) == (
        "tracker.classes.Pedestrian has settings and the data have none of it; pedestrian have the default ones; "
        "is tracker.classes.pedestrian meant?"
    )
    assert settings_without_data("sensors", {"lidar", "radar"}, {"lidar"}) is None  # all that is there has its own
    assert settings_without_data("sensors", {"lidar"}, {"lidar", "radar"}) is None
