"""`saga-fg learn`. `saga-fg learn interactions`: which form is written, and what tracking does with its file."""

import json
import math
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import yaml

import pipelines.learning.interactions as learned_module
from data_tools.datasets.detection_files import read_detections
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import TrackConfig, load_config, load_interactions
from pipelines.configuration import read_settings, write_settings
from pipelines.learning import LearnedNoise, learn_noise, learned_fragment
from pipelines.learning.interactions import (
    BASE,
    CAP,
    LEARNED,
    NOWHERE,
    SHIPPED,
    Contender,
    coupled_classes,
    held_out_parts,
    judged_on,
    learn_interactions,
)
from saga_fg import ConstantVelocity
from saga_fg.errors import InputError
from saga_fg.learning import FittedInteractions, fit_interactions, sample_with_truth
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.graph_building import LearnedInteractions
from saga_fg.model.interactions import VELOCITY, CarFollowing, velocity_triples
from saga_fg.model.sensor import NoiseModel, Sensor
from saga_fg.types.by_class import DEFAULT
from tests.pipelines.command import done, refused
from tests.saga_fg.following_pairs import RATE, following_pairs

FOLLOW = Following(CarFollowing(time_constant=float("inf")), rate=RATE, gap_scale=100.0)


@pytest.fixture(scope="module")
def scenes():
    return {
        name: following_pairs(pairs=2, moments=55, seed=seed, name=name, apart=40.0)
        for seed, name in enumerate(("one", "two"))
    }


def with_template(monkeypatch, *rules, fit=None):
    """Learning finds these rules, whatever the recordings say."""
    monkeypatch.setattr(learned_module, "TEMPLATE", rules)
    found = fit or (lambda sample, settings, template: FittedInteractions(tuple(template), 0.0))
    monkeypatch.setattr(learned_module, "fit_interactions", found)


def test_the_form_that_does_best_on_recordings_held_out_is_the_form_that_is_written(monkeypatch, scenes):
    with_template(monkeypatch, FOLLOW, fit=partial(fit_interactions, iterations=2))
    config = load_config("file")
    found = learn_interactions(scenes, "two scenes", config, passes=1)
    (group,) = (group for group in found.forms if "car" in group)
    ratios = found.ratios[group]
    assert set(ratios) == {"everywhere", "hidden", "refitted", SHIPPED}
    assert found.forms[group] == min(ratios, key=ratios.__getitem__) != NOWHERE
    assert ratios[found.forms[group]] < 1
    cars = [rule for rule in found.interactions.edges if "car" in rule.classes]
    of_config = config.tracker.edges[0].information_gain
    gain = {"everywhere": False, "hidden": True, "refitted": of_config, SHIPPED: of_config}
    assert {rule.information_gain for rule in cars} == {gain[found.forms[group]]}
    assert {run.contender for run in found.runs} == {BASE, SHIPPED, LEARNED}
    for name, scene in scenes.items():
        text = write_settings(found.held_out[name])
        read = config.with_interactions(read_settings(LearnedInteractions, text, "learned.yaml"))
        (again,) = judged_on({name: scene}, [Contender("again", "saga", read)], passes=1, seed=0)
        (tried,) = (run for run in found.runs if (run.contender, run.recording) == (LEARNED, name))
        assert len(again.outcomes) >= 2
        assert again.outcomes == tried.outcomes
    assert type(found.held_out["one"].edges[0]) is type(found.interactions.edges[0])


class Halting:
    """Followers come to a halt."""

    needs = (VELOCITY, ())

    def triples(self, nodes, target, source):
        return velocity_triples(nodes, target, source, by_velocity=-np.eye(2))


def test_edges_that_raise_errors_are_left_out_and_the_base_motion_remains(monkeypatch, scenes):
    with_template(monkeypatch, replace(FOLLOW, interaction=Halting()))
    config = load_config("file")
    config = replace(config, tracker=replace(config.tracker, edges=()))
    found = learn_interactions(scenes, "two scenes", config, passes=1)
    assert set(found.forms.values()) == {NOWHERE}
    assert found.interactions.edges == ()


def test_the_base_motion_is_the_tracker_that_is_written_if_no_form_helps(monkeypatch, scenes):
    with_template(monkeypatch, replace(FOLLOW, interaction=Halting()))
    config = load_config("file")
    tracker = replace(config.tracker, edges=(), traffic=replace(config.tracker.traffic, memory=60.0))
    config, tried = replace(config, tracker=tracker), []

    def judge(scenes, contenders, *args):
        tried.extend(contenders)
        return judged_on(scenes, contenders, *args)

    monkeypatch.setattr(learned_module, "judged_on", judge)
    found = learn_interactions(scenes, "two scenes", config, passes=1)
    assert set(found.forms.values()) == {NOWHERE}
    written = config.with_interactions(found.interactions)
    base = [each.config.of_method(each.method) for each in tried if each.name == BASE]
    assert [each.tracker for each in base] == [written.tracker] * 2


def test_a_search_begins_with_the_rules_of_an_earlier_result(monkeypatch, scenes):
    begun = []

    def fit(sample, settings, template):
        begun.append(tuple(template))
        return FittedInteractions(tuple(template), 0.0)

    with_template(monkeypatch, fit=fit)
    start = LearnedInteractions(edges=(replace(FOLLOW, information_gain=True),))
    found = learn_interactions(scenes, "two scenes", load_config("file"), start, 1)
    assert set(begun) == {start.edges}
    assert set(found.ratios[found_group(found)]) == {"refitted", SHIPPED}


def found_group(found):
    return next(group for group in found.forms if "car" in group)


def test_nothing_to_learn_from_is_an_error_and_halves_are_held_out():
    three = {name: following_pairs(pairs=1, moments=11, name=name) for name in "cab"}
    assert [list(part) for part in held_out_parts(three)] == [["c", "a"], ["b"]]
    first, second = held_out_parts({"c": three["c"]})
    assert [len(part["c"]) for part in (first, second)] == [5, 6]
    assert first["c"].frames[-1].timestamp < second["c"].timestamps[0] == second["c"].frames[0].timestamp
    short = {name: following_pairs(pairs=1, moments=6, name=name) for name in "ab"}
    with pytest.raises(InputError, match=r"nothing: expected objects that are followed for 1\.5 s and more"):
        learn_interactions(short, "nothing", load_config("file"), passes=1)


def test_classes_between_which_there_are_edges_are_one_group():
    for classes, groups in (
        ([("car", "bus"), ("pedestrian",)], [("bus", "car"), ("pedestrian",)]),
        ([("car",), ("bus",), ("bus", "car")], [("bus", "car")]),
        ([], []),
    ):
        assert coupled_classes([Neighbours(classes=each) for each in classes]) == groups


@pytest.fixture(scope="module")
def detections(tmp_path_factory):
    """Two queues of four cars, as a table of detections."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("queue") / "detections.csv"
    lines = ["timestamp,x,y,yaw,label,score"]
    speed, x = np.full(8, 8.0), np.array([30.0, 20, 10, 0, 30, 20, 10, 0])
    lane = np.array([0.0] * 4 + [60.0] * 4)
    for k in range(36):
        for i in range(8):
            lines.append(f"{0.25 * k:.2f},{x[i] + rng.normal(0, 0.05):.3f},{lane[i]:.3f},0.0,car,0.9")
        leaders = [0, 4]
        speed[leaders] += rng.normal(0, 0.4, 2)
        for lead in leaders:
            for i in range(lead + 1, lead + 4):
                speed[i] += 0.25 * (speed[i - 1] - speed[i])
        x = x + 0.25 * speed
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def learned(detections):
    output = detections.parent / "interactions.yaml"
    arguments = ["learn", "interactions", "file", detections, "--output", output, "--passes", "1"]
    with pytest.MonkeyPatch.context() as patch:  # the way to the file is tested here, not how good the fit is
        patch.setattr(learned_module, "fit_interactions", partial(fit_interactions, iterations=1))
        return output, done(*arguments, "--json", detections.parent / "figures.json").output


def test_edges_are_learned_from_unlabelled_detections(learned, detections):
    path, shown = learned
    assert "1 recording" in load_interactions(path).learned_from
    for text in ("forms of the edges", "base motion", "shipped edges", "learned edges", "errors after"):
        assert text in shown
    figures = json.loads((detections.parent / "figures.json").read_text(encoding="utf-8"))
    assert {row["contender"] for row in figures["errors"]} == {BASE, SHIPPED, LEARNED}
    assert all(0 <= min(row["mean"], row["median"]) <= CAP for row in figures["errors"])
    assert all(row["form"] in (*row["ratios"], NOWHERE) for row in figures["forms"])


def test_a_tracker_takes_them_over(learned, detections):
    path, _ = learned
    config = load_config("file").with_interactions(load_interactions(path))
    assert config.tracker.edges == load_interactions(path).edges
    tracks = detections.parent / "tracks.csv"
    done("track", "file", detections, "--interactions", path, "--output", tracks)
    assert len(tracks.read_text(encoding="utf-8").splitlines()) > 200


def test_mistakes_are_answered_with_one_line(learned, detections):
    wrong = detections.parent / "wrong.yaml"
    wrong.write_text("version: 9\n", encoding="utf-8")
    track = ["track", "file", str(detections), "--output", str(detections.parent / "t.csv")]
    assert "wrong.yaml: version: expected 1" in refused(*track, "--interactions", wrong)
    assert "goes with --method saga" in refused(*track, "--interactions", learned[0], "--method", "kf")


def test_the_files_that_are_read_are_not_overwritten(learned, detections):
    for path, others in ((detections, []), (learned[0], ["--start", str(learned[0])])):
        before = path.read_bytes()
        said = refused("learn", "interactions", "file", detections, "--output", path, *others)
        assert "expected another file than those that are read" in said
        assert path.read_bytes() == before


# Noise learned from simulated traffic, with and without ground truth, is the noise the sensors were simulated with

WORLD = SimulatorSettings(duration=4.0)
WORST = 1.35  # factor between what was learned and the truth, at ranges where traffic is


@pytest.fixture(scope="module", params=[True, False], ids=["with truth", "without truth"])
def noise_learned(request: pytest.FixtureRequest) -> LearnedNoise:
    return learned_noise(request.param)


@cache
def learned_noise(with_truth: bool) -> LearnedNoise:
    """Noise learned from a start that is wrong everywhere."""
    start = load_config("simulated")
    wrong = Sensor(noise={DEFAULT: NoiseModel(position=0.3, range_noise=0.01, bearing_noise=0.01)})
    start = replace(start, sensors={DEFAULT: wrong})
    dataset = SimulatedTraffic(WORLD, scenes=2, seed=7)
    return learn_noise(dataset, dataset.scenes, start, with_truth=with_truth)


def acceleration_noise(config: TrackConfig) -> float:
    motion = config.tracker.classes[DEFAULT].motion
    assert isinstance(motion, ConstantVelocity)
    return motion.acceleration_noise


def test_deviations(noise_learned):
    for name, truth in WORLD.sensors.items():
        noise = noise_learned.config.sensors[name].noise[DEFAULT]
        pairs = (noise.range_noise, truth.range_noise), (noise.bearing_noise, truth.bearing_noise)
        for distance in (12.0, 25.0, 40.0):
            for slope, (base, growth) in pairs:
                ratio = math.hypot(noise.position, slope * distance) / (base + growth * distance)
                assert 1 / WORST < ratio < WORST
        assert noise.yaw == pytest.approx(truth.yaw_noise, rel=0.2)
        assert noise.height == pytest.approx(truth.height_noise, rel=0.2)
    assert noise_learned.config.sensors["camera"].noise[DEFAULT].velocity == pytest.approx(1.0, rel=0.2)


def test_scores_are_worth_on_another_scene_what_was_learned(noise_learned, request):
    with_truth = request.node.callspec.params["noise_learned"]
    other = SimulatedTraffic(WORLD, scenes=1, seed=8)
    for name, (sample, _) in sample_with_truth([other.scene(other.scenes[0])], noise_learned.config.sensors).items():
        p, raw = (
            sensor.calibrated(sample.logit, sample.label) for sensor in (noise_learned.config.sensors[name], Sensor())
        )
        loss, before = (-np.log(np.where(sample.true, q, 1 - q)).mean() for q in (p, raw))
        assert loss < (1.0 if with_truth else 1.1) * before  # what comes back counts as true, be it clutter
        assert p.mean() == pytest.approx(sample.true.mean(), abs=0.1 if with_truth else 0.15)


def test_fields_of_view_and_chances(noise_learned):
    lidar, camera = noise_learned.config.sensors["lidar"], noise_learned.config.sensors["camera"]
    half = math.radians(60)
    assert camera.field_of_view.min_azimuth == pytest.approx(-half, abs=0.1)
    assert camera.field_of_view.max_azimuth == pytest.approx(half, abs=0.1)
    assert lidar.field_of_view.max_azimuth - lidar.field_of_view.min_azimuth == pytest.approx(2 * math.pi)
    assert 0.8 < lidar.detection_probability <= 0.97
    assert 0.5 < camera.detection_probability <= 0.9


def test_the_fragment_leads_to_the_learned_settings(noise_learned, tmp_path):
    path = tmp_path / "noise.yaml"
    path.write_text(learned_fragment(noise_learned, "a test"))
    config = load_config("simulated", path)
    for name, sensor in noise_learned.config.sensors.items():
        if name in noise_learned.detections:
            assert config.sensors[name].noise[DEFAULT].position == pytest.approx(
                sensor.noise[DEFAULT].position, rel=1e-3
            )
            assert config.sensors[name].field_of_view.max_range == pytest.approx(
                sensor.field_of_view.max_range, rel=1e-3
            )
    q = noise_learned.config.tracker.classes[DEFAULT].motion.acceleration_noise  # type: ignore[attr-defined]
    assert config.tracker.classes[DEFAULT].motion.acceleration_noise == pytest.approx(q, rel=1e-3)  # type: ignore[attr-defined]


def test_process_noise_is_alike_with_and_without_truth():
    with_truth, without = (acceleration_noise(learned_noise(truth).config) for truth in (True, False))
    assert 0.5 < with_truth / without < 2.0


def test_the_command_learns_from_a_file_without_truth_and_tracks_with_it(tmp_path):
    rng = np.random.default_rng(0)
    rows = ["timestamp,x,y,label,score"]
    for k in range(60):
        for lane in range(4):
            x, y = np.array([8.0 * k / 10 + 15 * lane, 4.0 * lane]) + 0.25 * rng.standard_normal(2)
            rows.append(f"{k / 10},{x},{y},car,0.8")
    detections, noise, tracks = (tmp_path / name for name in ("detections.csv", "noise.yaml", "tracks.csv"))
    detections.write_text("\n".join(rows))
    result = done("learn", "noise", "file", detections, "-o", noise)
    assert "240 detections" in result.output
    position = yaml.safe_load(noise.read_text())["sensors"]["sensor"]["noise"]["default"]["position"]
    assert position == pytest.approx(0.25, rel=0.15)
    done("track", "file", detections, "--config", noise, "-o", tracks)


def test_little_or_nothing_detected_is_said(tmp_path, caplog):
    (tmp_path / "empty.csv").write_text("timestamp,x,y\n0.0,,\n0.1,,\n")
    said = refused("learn", "noise", "file", tmp_path / "empty.csv", "-o", tmp_path / "noise.yaml")
    assert "expected detections to learn from" in said
    assert not (tmp_path / "noise.yaml").exists()
    rows = [f"{k / 10},{0.8 * k},0.0" for k in range(4)]
    (tmp_path / "few.csv").write_text("\n".join(["timestamp,x,y", *rows]))
    dataset = read_detections(tmp_path / "few.csv")
    learn_noise(dataset, dataset.scenes, load_config("file"), with_truth=False)
    assert "learned from 4 detections only" in caplog.text
