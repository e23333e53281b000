"""Tracking with nonlinear motion, radars, confused classes and every estimator."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recording_sets import recording_set
from data_tools.datasets.detection_files import read_detections, read_tracks
from data_tools.metrics import SceneMetrics, scene_metrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings, simulate_scene
from pipelines.config import load_config
from pipelines.configuration.reading import read_settings
from pipelines.learning import learn_noise, learned_fragment
from pipelines.smoothing import load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg import Detection, Detections, Frame, Tracker, TrackerSettings
from saga_fg.errors import InputError
from saga_fg.estimators import GraphFilter
from saga_fg.learning import learn_confusion
from saga_fg.model.discretisation import Transition
from saga_fg.types.boxes import Boxes
from tests.pipelines.command import done

SETTINGS = """
estimator: {estimator}
classes:
  car: {{motion: {{kind: {motion}}}, max_deviation: .inf}}
  pedestrian: {{motion: {{kind: constant_velocity, acceleration_noise: 0.3}}, max_deviation: .inf}}
edges: [{edges}]
"""
ESTIMATORS = ("kalman", "isam2", "fixed-lag")


def tracker(estimator, edges="", motion="constant_velocity", more=""):
    text = SETTINGS.format(estimator=estimator, edges=edges, motion=motion) + more
    return Tracker(read_settings(TrackerSettings, text))


def tracked(tracker, label, path, seen, dt=0.1):
    """The last track of an object on a path, hidden after `seen` frames, and where it is."""
    for k in range(len(path)):
        boxes = [Detection(label, (*path[k], 1.0), score=0.9)] if k < seen else []
        tracks = tracker.step(Frame(k * dt, "lidar", Detections.of(boxes)))
    (track,) = tracks
    return track, path[-1]


@pytest.mark.parametrize(
    ("estimator", "motion"), [("kalman", "mixture"), ("isam2", "coordinated_turn"), ("fixed-lag", "mixture")]
)
def test_a_hidden_car_goes_on_turning(estimator, motion):
    angle = 0.5 * np.arange(55) * 0.1
    path = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    straight, there = tracked(tracker(estimator), "car", path, 40)
    turning, _ = tracked(tracker(estimator, motion=motion), "car", path, 40)
    errors = [np.hypot(*(track.position[:2] - there)) for track in (straight, turning)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[0] > 2.0


@pytest.mark.parametrize("estimator", ["isam2", "fixed-lag"])
def test_nonlinear_motion_is_linearised_again_where_measurements_put_it(estimator):
    angle = 0.8 * np.arange(40) * 0.1
    path = 12.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    for motion, again in (("coordinated_turn", True), ("constant_velocity", False)):
        one, other = (tracked(tracker(n, motion=motion), "car", path, 40)[0].position for n in ("kalman", estimator))
        apart = np.abs(np.subtract(one, other)).max()
        assert apart < 0.1
        assert (apart > 1e-6) == again


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_hidden_pedestrian_does_not_walk_through_a_wall(estimator):
    wall = "road_map: {walls: [{name: house, points: [[-9, 4], [9, 4]]}], deviation: 0.05}\n"
    rule = "{kind: repulsion, sources: [wall]}"
    path = np.stack([0.2 * np.arange(45) * 0.1, 1.2 * np.arange(45) * 0.1], axis=1)
    through, _ = tracked(tracker(estimator, more=wall), "pedestrian", path, 20)
    before, _ = tracked(tracker(estimator, rule, more=wall), "pedestrian", path, 20)
    assert through.position[1] > 4.5
    assert before.position[1] < 4.0


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_hidden_follower_brakes_behind_its_leader(estimator):
    rule = "{kind: following, rate: 1.0, interaction: {kind: smooth_driver}, lateral_scale: 3.0}"
    ends = []
    for edges in ("", rule):
        one = tracker(estimator, edges)
        x, speed = 0.0, 10.0
        for k in range(50):
            speed = max(speed - 0.3, 0.0) if k >= 30 else speed
            x += 0.1 * speed
            seen = [Detection("car", (x, 0.0, 1.0), score=0.9)]
            if k < 30:
                seen.append(Detection("car", (k * 1.0 - 16.0, 0.0, 1.0), score=0.9))
            tracks = one.step(Frame(k / 10, "lidar", Detections.of(seen)))
        leader, follower = sorted(tracks, key=lambda track: -track.position[0])
        ends.append((leader.position[0] - follower.position[0], follower.velocity[0]))
    assert ends[1][0] > ends[0][0] + 1.0
    assert ends[1][1] < ends[0][1] - 1.0


def test_pedestrians_who_walk_into_each_other_step_aside():
    gaps = []
    for edges in ("", "{kind: repulsion}"):
        one = tracker("kalman", edges)
        for k in range(50):
            y = 0.12 * k - 3.0
            seen = [
                Detection("pedestrian", (0.1, y, 1.0), score=0.9),
                Detection("pedestrian", (-0.1, -y, 1.0), score=0.9),
            ]
            tracks = one.step(Frame(k / 10, "lidar", Detections.of(seen if k < 18 else [])))
            if k == 26:
                a, b = (track.position[0] for track in tracks)
                gaps.append(abs(a - b))
    assert gaps[1] > gaps[0] + 0.1


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_modes_know_what_stands_and_do_not_lose_it_when_it_departs(estimator):
    """A car at a light, which drives off after five seconds."""
    errors = []
    for motion in ("constant_velocity", "mixture"):
        rng, one, x, off = np.random.default_rng(1), tracker(estimator, motion=motion), 0.0, []
        for k in range(80):
            speed = 0.0 if k < 50 else min(8.0, 0.3 * (k - 50))
            x += 0.1 * speed
            seen = [Detection("car", (x + 0.2 * rng.normal(), 0.2 * rng.normal(), 1.0), score=0.9)]
            (track,) = one.step(Frame(k / 10, "lidar", Detections.of(seen)))
            off.append(np.hypot(track.velocity[0] - speed, track.velocity[1]))
        errors.append([np.mean(off[20:50]), np.mean(off[60:])])
    assert errors[1][0] < 0.5 * errors[0][0]
    assert errors[1][1] < 1.3 * errors[0][1]


# Gain of the range rate of a radar for the velocity of tracks, on simulated traffic


def test_a_table_with_range_rates_ends_in_tracks_that_move_along_the_line_of_sight(tmp_path):
    table = tmp_path / "radar.csv"
    table.write_text(
        "timestamp,sensor,label,x,y,range_rate,ego_x,ego_y,ego_yaw\n"
        "0.0,radar,car,30.0,0.0,-8.0,0,0,0\n"
        "0.1,radar,car,30.4,0.1,-8.1,1,0,0\n"
        "0.1,lidar,car,29.2,0.0,,1,0,0\n"
    )
    done("track", "file", table, "--output", tmp_path / "tracks.csv")
    assert read_tracks(tmp_path / "tracks.csv").boxes.velocity[-1, 0] < -5.0


def test_a_table_with_range_rates_but_no_poses_is_refused(tmp_path):
    table = tmp_path / "radar.csv"
    table.write_text("timestamp,x,y,range_rate\n0.0,30.0,0.0,-8.0\n")
    with pytest.raises(InputError, match=r"radar.csv: scene radar: world_T_ego: expected a pose, since range_rate"):
        read_detections(table).scene("radar")


# Sensors that mistake cars, trucks and buses for one another: confusion learned, tracks and labels with beliefs

RIGHT = {"lidar": 0.9, "camera": 0.7}
VEHICLES = ("bus", "car", "truck")


def simulator(duration, right=RIGHT):
    plain = SimulatorSettings(duration=duration)
    return replace(plain, sensors={n: replace(plain.sensors[n], class_accuracy=share) for n, share in right.items()})


def believing(config):
    tables = {n: {c: {z: p if z == c else (1 - p) / 2 for z in VEHICLES} for c in VEHICLES} for n, p in RIGHT.items()}
    return replace(config, sensors={n: replace(config.sensors[n], confusion=table) for n, table in tables.items()})


def test_confusion_and_sizes_are_found_by_sensor(tmp_path):
    dataset = SimulatedTraffic(simulator(5.0), scenes=1, seed=702)
    learned = learn_noise(dataset, dataset.scenes, load_config("simulated"), True)
    path = tmp_path / "learned.yaml"
    path.write_text(learned_fragment(learned, "a test"))
    read = load_config("simulated", path)
    for name, share in RIGHT.items():
        row = read.sensors[name].confusion["car"]
        assert row["car"] / sum(row.values()) == pytest.approx(share, abs=0.06)
        assert row["bus"] / sum(row.values()) == pytest.approx((1 - share) / 2, abs=0.05)
    sizes = {c: read.tracker.classes[c].typical_size for c in VEHICLES}
    assert sizes["car"].length == pytest.approx(4.7, abs=0.5)
    assert sizes["bus"].length == pytest.approx(12.0, abs=1.0)
    assert "typical_size" not in path.read_text().split("pedestrian:")[-1].split("truck:")[0]


def test_detectors_with_an_output_for_each_class_confuse_nothing():
    scene = simulate_scene(simulator(2.0, {"lidar": 1.0}), seed=702)
    frames = []
    for frame in scene.frames:  # every third car or bus is reported as a truck in its place too
        boxes, score = frame.detections.boxes, frame.detections.score
        rows = np.flatnonzero(np.isin(boxes.label, ("car", "bus")))[::3]
        twins = replace(boxes.select(rows), label=np.full(len(rows), "truck"))
        both = Detections(Boxes.concatenate([boxes, twins]), np.concatenate([score, 0.9 * score[rows]]))
        frames.append(replace(frame, detections=both))
    sensors = load_config("simulated").sensors
    assert learn_confusion([scene], sensors) == {"lidar": {}}
    assert learn_confusion([replace(scene, frames=tuple(frames))], sensors) == {"lidar": {}}


def test_beliefs_leave_one_track_and_one_label_an_object():
    plain = load_config("simulated")
    scene = simulate_scene(simulator(4.0), seed=702)
    assert scene.ground_truth is not None
    runs = {}
    for name, config in (("plain", plain), ("believing", believing(plain))):
        tracks = track_scene(scene, config.new_tracker("saga")).tracks
        vehicles = {id_ for each in tracks for id_ in each.id[each.boxes.label != "pedestrian"].tolist()}
        runs[name] = SceneMetrics.pool([scene_metrics(scene.ground_truth, tracks)]).mota, len(vehicles)
    assert runs["believing"][0] > 0.85
    assert runs["plain"][0] < 0.3
    assert runs["believing"][1] < 0.6 * runs["plain"][1]
    settings = load_smooth_config("simulated")
    counts = {}
    for name, of in (("plain", settings), ("believing", replace(believing(settings), tracking=believing(plain)))):
        labels, wrong, found = smooth_scene(scene, of).labels, 0, 0
        for moment, truth in zip(labels, scene.ground_truth, strict=True):
            boxes, true = moment.tracks.boxes, truth.boxes
            apart = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - true.position[:, :2], -1, 0))
            near = (apart < 1.0) & np.isin(true.label, VEHICLES)
            wrong += int((near & (boxes.label[:, None] != true.label)).sum())
            found += int(near.sum())
        counts[name] = wrong / found
    assert counts["plain"] > 0.2
    assert counts["believing"] < 0.05


# Without bounds, iSAM2 tracks recordings as the joint Kalman filter does, and interactions are its factors


@pytest.mark.parametrize(("name", "scene", "count"), [("megvii", "scene-0655", 20), ("kitti", "0011", 30)])
def test_isam2_gives_the_tracks_of_kalman(recordings, name, scene, count):
    chosen = recording_set(name, recordings, 1)
    config = load_config(chosen.family)
    exact = replace(config.tracker, tolerance=0.0, max_component=None)
    trackers = [
        replace(config, tracker=replace(exact, estimator=estimator)).new_tracker("saga")
        for estimator in ("kalman", "isam2")
    ]
    for frame in list(chosen.dataset.scene(scene).frames)[:count]:
        for tracker in trackers:
            tracker.step(frame)
        expected, found = (tracker.tracks(frame.timestamp) for tracker in trackers)
        assert expected.id.tolist() == found.id.tolist()
        np.testing.assert_allclose(found.boxes.position, expected.boxes.position, rtol=0, atol=1e-9)


def test_every_edge_of_a_frame_is_a_factor_of_isam2(recordings, monkeypatch):
    """On the states of three or more nodes and epochs; no variable is larger than the state of one node."""
    predict, frames = GraphFilter.predict, list[tuple[int, int, int]]()

    def traced(self: GraphFilter, transition: Transition) -> None:
        predict(self, transition)
        edges = {
            (i, j)
            for F in transition.F
            for i, j, block in zip(transition.nodes[F.target], transition.nodes[F.source], F.values, strict=True)
            if i != j and block.any()
        }
        if transition.dt == 0 or not edges:
            return
        isam = self._smoother._ready().isam
        held = isam.getFactorsUnsafe()
        factors = [set(held.at(slot).keys()) for slot in range(held.size()) if held.exists(slot)]
        earlier, now = (epoch.keys for epoch in self._window.epochs[-2:])
        found = sum(any({now[i], earlier[i], earlier[j]} <= keys for keys in factors) for i, j in edges)
        frames.append((len(edges), found, sum(len(keys) >= 3 for keys in factors)))
        assert max(isam.getDelta().at(key).size for keys in factors for key in keys) <= transition.graph.dims.max()

    monkeypatch.setattr(GraphFilter, "predict", traced)
    chosen, config = recording_set("kitti", recordings, 1), load_config("kitti")
    tracker = replace(config, tracker=replace(config.tracker, estimator="isam2")).new_tracker("saga")
    for frame in list(chosen.dataset.scene("0011").frames)[:120]:
        tracker.step(frame)
    edges, found, wide = np.sum(frames, axis=0)
    print(f"{len(frames)} frames with {edges} edges, {found} of them factors of iSAM2; {wide} of three or more in all")
    assert found == edges
    assert len(frames) > 60
    assert wide > 180
