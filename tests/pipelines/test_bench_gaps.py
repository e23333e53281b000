"""The benchmark of gaps: which gaps there are, how a run is judged on them, and the command from end to end."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.bench.gaps import fitted, sources
from pipelines.bench.gaps.bench import Contender, GapBenchSettings, bench_gaps, hidden, prepared, run_of
from pipelines.bench.gaps.contenders import KEPT_ALIVE, LIFE, contenders, with_life
from pipelines.bench.gaps.fitted import Split, splits_of
from pipelines.bench.gaps.gap import FOLLOWED, LENGTHS, SPACING, Gap, made_gaps, real_gaps
from pipelines.bench.gaps.judging import CAP, JudgedRun, Links
from pipelines.bench.gaps.labelled import LabelledScene
from pipelines.bench.gaps.learned import LearnedForms
from pipelines.bench.gaps.picture import drawn_gap, gap_picture, telling_gap
from pipelines.bench.gaps.situations import situations_of
from pipelines.bench.gaps.sources import RecordingSource
from pipelines.bench.gaps.summary import gap_figures, link_figures
from pipelines.bench.recordings import simulated_set
from pipelines.bench.variants import changed
from pipelines.cli import app
from pipelines.config import Family, load_config
from saga_fg import Annotations, Boxes, Detections, Frame, InputError, Scene, Tracks
from saga_fg.model.learned_interactions import LearnedInteractions
from saga_fg.model.motion import ConstantVelocity
from saga_fg.model.road.stopping import RedLight
from saga_fg.model.turning import CoordinatedTurn

SHORT = replace(SimulatorSettings(), duration=12.0, warm_up=5.0)
TIMES = 0.5 * np.arange(16)
SPEED = 2.0  # m/s
Places = Mapping[str, Sequence[float | None]]
"""x of each object or track at each moment, m; None where it is not there."""


def boxes(x: Sequence[float]) -> Boxes:
    return Boxes.of(["car"] * len(x), [[each, 0.0, 1.0] for each in x], velocity=[[SPEED, 0.0]] * len(x))


def scene(labels: Places, detections: Places) -> Scene:
    """Labels at all moments, and a frame of detections at each."""
    truth, frames = [], []
    for k, time in enumerate(TIMES.tolist()):
        there = {name: x[k] for name, x in labels.items() if x[k] is not None}
        truth.append(
            Annotations(np.array(list(there), dtype=np.str_), boxes(list(there.values())), np.ones(len(there), bool))
        )
        seen = [x[k] for x in detections.values() if x[k] is not None]
        frames.append(Frame(time, "lidar", Detections(boxes(seen), np.ones(len(seen)))))
    poses = np.tile(np.eye(4), (len(TIMES), 1, 1))
    return Scene("drawn", TIMES, poses, ("",) * len(TIMES), frames, truth)


def tracks(places: Places, detected: Mapping[str, Sequence[bool]]) -> list[Tracks]:
    """Tracks named by numbers, and whether each has a detection at each moment."""
    found, last = [], dict.fromkeys(places, 0.0)
    for k, time in enumerate(TIMES.tolist()):
        there = {name: x[k] for name, x in places.items() if x[k] is not None}
        last |= {name: time for name in there if detected[name][k]}
        n = len(there)
        wide = np.tile(np.eye(2), (n, 1, 1))
        coasting = np.array([time - last[name] for name in there])
        ids = np.array([int(name) for name in there], dtype=np.int64)
        found.append(Tracks(time, ids, boxes(list(there.values())), np.ones(n), wide, wide, coasting))
    return found


def straight(start: float = 0.0) -> list[float]:
    return (start + SPEED * TIMES).tolist()


def without(x: Sequence[float], gone: range) -> list[float | None]:
    return [None if k in gone else each for k, each in enumerate(x)]


HIDDEN = range(5, 9)  # 2.5 to 4 s: the last detection is at 2 s, the next at 4.5 s
SEEN = [k not in HIDDEN for k in range(len(TIMES))]
ALWAYS = [True] * len(TIMES)


def labelled(labels: Places, detections: Places) -> LabelledScene:
    return LabelledScene.of(scene(labels, detections), {})


def test_a_real_gap_is_from_the_last_detection_to_the_next() -> None:
    found = real_gaps(labelled({"a": straight()}, {"a": without(straight(), HIDDEN)}))
    assert found == [Gap(0, 4, 9, 2.5, moving=True)]
    parked = [0.0] * len(TIMES)
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, HIDDEN)})) == [Gap(0, 4, 9, 2.5, moving=False)]
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, range(5, 16))})) == [], "it never returns"
    assert real_gaps(labelled({"a": parked}, {"a": without(parked, range(1, 15))})) == [], "longer than 6 s"
    once = [k != 1 and k not in HIDDEN for k in range(16)]
    assert (
        real_gaps(labelled({"a": parked}, {"a": [0.0 if s and k > 3 else None for k, s in enumerate(once)]})) == []
    ), "seen once before"


def test_a_duplicate_of_a_neighbour_is_no_detection_of_a_hidden_object() -> None:
    beside = straight(2.5)
    detections = {"a": without(straight(), HIDDEN), "b": beside, "ghost of b": straight(1.7)}
    assert [gap.row for gap in real_gaps(labelled({"a": straight(), "b": beside}, detections))] == [0]


def test_an_identity_is_kept_where_the_same_track_goes_on() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    off = [x + (1.5 if k in HIDDEN else 0.0) for k, x in enumerate(straight())]
    judged = JudgedRun(drawn, tracks({"7": off}, {"7": SEEN}))
    outcome = judged.outcome(gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, True, True)
    assert outcome.error == pytest.approx(1.5)
    assert outcome.at == pytest.approx({1.0: 1.5, 2.0: 1.5})
    assert judged.links() == Links(right=1)


def test_a_track_that_ends_is_lost_and_costs_the_cap() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(6, 16)), "8": without(straight(), range(9))}
    judged = JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN}))
    outcome = judged.outcome(gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, False, False)
    assert outcome.error == pytest.approx(3 * CAP / 4), "still there at the first of four moments"
    assert judged.links() == Links()
    nobody = JudgedRun(drawn, tracks({}, {})).outcome(gap)
    assert (nobody.held, nobody.kept, nobody.reported, nobody.error) == (False, False, False, CAP)


def test_a_track_that_stays_beside_the_one_that_takes_the_detections_keeps_no_identity() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": straight(), "8": without(straight(0.3), range(9))}
    old = [k < 5 for k in range(16)]
    assert not JudgedRun(drawn, tracks(places, {"7": old, "8": SEEN})).outcome(gap).kept


def test_an_identity_may_be_handed_over_within_half_a_second() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(9, 10)), "8": without(straight(), [*range(9), *range(10, 16)])}
    assert JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN})).outcome(gap).kept
    later = {"7": without(straight(), range(9, 12)), "8": without(straight(), [*range(9), *range(12, 16)])}
    assert not JudgedRun(drawn, tracks(later, {"7": SEEN, "8": SEEN})).outcome(gap).kept


def test_a_track_that_goes_on_with_another_object_is_a_false_link() -> None:
    other = without(straight(4.0), range(9))
    labels = {"a": without(straight(), range(9, 16)), "b": other}
    drawn = labelled(labels, {"a": without(straight(), range(5, 16)), "b": other})
    place = [*straight()[:9], *straight(4.0)[9:]]
    judged = JudgedRun(drawn, tracks({"7": place}, {"7": SEEN}))
    assert judged.links() == Links(false=1)
    clutter = JudgedRun(drawn, tracks({"7": [*straight()[:9], *straight(40.0)[9:]]}, {"7": SEEN}))
    assert clutter.links() == Links(unknown=1)


def test_a_tracker_that_reports_nothing_unseen_is_extrapolated() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    found = tracks({"7": without(straight(), HIDDEN)}, {"7": SEEN})
    assert JudgedRun(drawn, found, extrapolated=True).outcome(gap).error == pytest.approx(0.0, abs=1e-9)
    assert JudgedRun(drawn, found).outcome(gap).error == CAP


def test_the_picture_shows_the_gap_that_tells_most() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    gaps, base = real_gaps(drawn), load_config("file")
    pair = [Contender.of(contenders("file")[name], base) for name in ("centerpoint", "kf")]
    worse, better = ([run_of(drawn, gaps, each, life)] for each, life in zip(pair, ("shipped", "kept"), strict=True))
    assert telling_gap(better, worse) == ("drawn", gaps[0])
    shown = [drawn_gap(drawn, gaps, gaps[0], each, "kept") for each in pair]
    assert [each.holders[4] for each in shown] == [each.holders[9] for each in shown] != [None, None]
    figure = gap_picture(drawn, gaps[0], shown)
    assert [ax.get_title(loc="left").split(",")[0] for ax in figure.axes] == [
        "centerpoint: identity kept",
        "kf: identity kept",
    ]
    with pytest.raises(InputError, match="--picture: expected recordings with gaps"):
        telling_gap([], [])


def test_made_gaps_hide_one_object_among_others() -> None:
    config = load_config("simulated")
    traffic = LabelledScene.of(simulate_scene(SHORT, seed=4), config.sensors)
    gaps = made_gaps(traffic, passes=2, seed=0)
    assert gaps == made_gaps(traffic, passes=2, seed=0)
    assert {gap.run for gap in gaps} == {1, 2}
    assert {gap.length for gap in gaps} <= set(LENGTHS)
    still = made_gaps(traffic, passes=2, seed=0, chosen=lambda gap: not gap.moving)
    assert not any(gap.moving for gap in still)
    time = traffic.scene.timestamps
    for gap in gaps:
        assert time[gap.stop - 1] - time[gap.start] == pytest.approx(gap.length, abs=0.06)
        assert traffic.detected[[gap.start, gap.stop], gap.row].all()
        assert time[gap.start] >= FOLLOWED - 0.1
    first = [gap for gap in gaps if gap.run == 1]
    for a in first:
        for b in first:
            together = range(max(a.start, b.start), min(a.stop, b.stop) + 1)
            if a is not b and together:
                assert a.row != b.row
                apart = traffic.position[together[0], a.row] - traffic.position[together[0], b.row]
                assert np.hypot(*apart) >= SPACING
    frames = hidden(traffic, first)
    assert len(frames) == len(traffic.scene.frames)
    without_them = LabelledScene.of(replace(traffic.scene, frames=frames), config.sensors)
    for gap in first:
        inside = slice(gap.start + 1, gap.stop)
        assert not without_them.detected[inside, gap.row].any()
        assert without_them.detected[[gap.start, gap.stop], gap.row].all()
    mine = [gap.row for gap in first]
    others = np.delete(traffic.detected, mine, axis=1)
    assert (np.delete(without_them.detected, mine, axis=1) == others).all()


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated scenes of the benchmark that last for seconds."""
    settings = replace(SHORT, duration=7.0)
    monkeypatch.setattr(sources, "_set", lambda name, data, scenes, *_: simulated_set(scenes, settings=settings))


@pytest.mark.parametrize("family", ["nuscenes", "kitti", "simulated", "file"])
def test_contenders_and_lives_are_settings_of_every_kind_of_data(family: Family) -> None:
    base = load_config(family)
    for name, value in KEPT_ALIVE.items():
        changed(base, name, value)
    for variant in contenders(family).values():
        config = with_life(variant.config(base), "kept")
        config.new_tracker(variant.method)
        assert config.tracker.max_coasting == LIFE
        assert with_life(config, "shipped") is config


def test_classical_contenders_differ_in_motion_alone() -> None:
    base = load_config("kitti")
    turn = contenders("kitti")["stationary + turn"].config(base).tracker
    assert isinstance(turn.classes["default"].motion, CoordinatedTurn)
    assert isinstance(turn.classes["pedestrian"].motion, ConstantVelocity)
    assert turn.stationarity.prior == 0.5
    alone = contenders("kitti")["constant velocity"].config(base).tracker
    assert alone.stationarity.prior == 0
    assert alone.classes["default"].max_deviation == base.tracker.classes["default"].max_deviation
    assert Contender.of(contenders("kitti")["kf"], base).same_as(Contender("classical", "kf", base))
    assert not Contender.of(contenders("kitti")["saga"], base).same_as(Contender("classical", "kf", base))


def test_parts_of_the_graph_are_contenders_where_they_are_configured() -> None:
    base = load_config("heterogeneous")
    rules = contenders("heterogeneous")["without lights"].config(base).tracker.edges
    assert {type(rule) for rule in base.tracker.edges} - {type(rule) for rule in rules} == {RedLight}
    assert contenders("traffic")["without trails"].config(load_config("traffic")).tracker.traffic.reach == 0
    assert load_config("traffic").tracker.traffic.reach > 0


def test_a_hidden_car_is_followed_by_a_filter_that_is_kept_alive() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    kf = Contender.of(contenders("file")["kf"], load_config("file"))
    gaps = real_gaps(drawn)
    kept, shipped = (run_of(drawn, gaps, kf, life) for life in ("kept", "shipped"))
    assert kept.outcomes[0].error < 0.5
    assert kept.outcomes[0].kept
    assert not shipped.outcomes[0].reported
    rows = {(f.life, f.contender): f for f in gap_figures([kept, shipped], "kf")}
    assert rows["kept", "kf"].kept.estimate == 1.0
    assert rows["shipped", "kf"].reported == 0.0
    assert [each.right for each in link_figures([kept, shipped])] == [1, 1]  # the second one is re-linked


def test_recordings_are_dealt() -> None:
    five = ("a", "b", "c", "d", "e")
    assert splits_of(five) == [Split((), five)]
    assert splits_of(five, train=("a", "x")) == [Split(("a",), ("b", "c", "d", "e"))]
    assert splits_of(five, train=("a",), test=("b",)) == [Split(("a",), ("b",))]
    assert splits_of(five, test=("x",)) == []
    assert splits_of(five, folds=2) == [Split(("b", "d"), ("a", "c", "e")), Split(("a", "c", "e"), ("b", "d"))]
    with pytest.raises(InputError, match="--folds 6: expected at most the number of recordings, 5"):
        splits_of(five, folds=6)
    place = {"a": "north", "b": "south", "c": "north"}
    apart = [Split(("b", "d"), ("a", "c")), Split(("a", "c", "d"), ("b",)), Split(("a", "b", "c"), ("d",))]
    assert splits_of(five[:4], folds=0, unit=place) == apart
    assert splits_of(five[:3], folds=2, unit=place) == [Split(("b",), ("a", "c")), Split(("a", "c"), ("b",))]
    with pytest.raises(InputError, match="--folds place: expected recordings of two places or more, all are of north"):
        splits_of(("a", "c"), folds=0, unit=place)


def test_places_are_sites_and_settings() -> None:
    names = ("USA_Lanker-1_10_T-1", "USA_Lanker-2_4_T-1", "USA_US101-1_1_T-1")
    assert list(RecordingSource("ngsim").places(names).values()) == ["USA_Lanker", "USA_Lanker", "USA_US101"]
    assert RecordingSource("kitti").places(("0000",)) == {}


def test_nothing_is_hidden_from_above() -> None:
    assert RecordingSource("ngsim").complete
    assert not RecordingSource("ngsim", viewpoint="mast").complete
    assert not RecordingSource("kitti").complete


@pytest.mark.usefixtures("short_scenes")
def test_gaps_may_be_of_some_situations_alone() -> None:
    source = RecordingSource("simulated", scenes=1, labels=True)
    settings = GapBenchSettings(1, ("kept",), (2.0,), of=("visible leader", "turning"))
    labelled, gaps = prepared(source, "scene-0001", settings, load_config("simulated").sensors)
    made = [gap for gap in gaps if gap.run > 0]
    assert made
    found = [situations_of(labelled, gap)[2.0] for gap in made]
    assert all(each & {"visible leader", "turning"} for each in found)
    assert any("visible leader" in each for each in found)


def test_fitted_noise_reaches_the_classes_and_nothing_else() -> None:
    config = load_config("simulated")
    fitted = config.with_motions({"default": ConstantVelocity(0.5), "truck": ConstantVelocity(0.25)})
    classes = fitted.tracker.classes
    assert classes["truck"].motion.acceleration_noise == 0.25
    assert classes["default"].motion.acceleration_noise == 0.5
    assert classes["pedestrian"] == config.tracker.classes["pedestrian"]
    assert classes["truck"].max_distance == classes["default"].max_distance
    assert fitted.tracker.edges == config.tracker.edges


@pytest.mark.usefixtures("short_scenes")
def test_contenders_are_fitted_to_the_recordings_that_teach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learning finds no interactions here: then saga is kf."""
    taught_by = []

    def learn(recordings, origin, base, **how):  # type: ignore[no-untyped-def]
        taught_by.append(origin)
        return LearnedForms(LearnedInteractions(learned_from=origin), {}, {}, (), {})

    monkeypatch.setattr(fitted, "learn_interactions", learn)
    base = load_config("simulated")
    kf = Contender.of(contenders("simulated")["kf"], base)
    source = RecordingSource("simulated", scenes=2, labels=True)
    splits, settings = splits_of(("scene-0001", "scene-0002"), folds=2), GapBenchSettings(0, ("kept",))
    runs = fitted.bench_splits(source, splits, [kf], base, settings)
    assert taught_by == ["recordings scene-0002", "recordings scene-0001"]
    names = ["kf", "kf, fitted noise", "saga, learned edges"]
    assert [(run.recording, run.contender) for run in runs] == [
        (s, n) for s in ("scene-0001", "scene-0002") for n in names
    ]
    assert runs[0].outcomes == runs[2].outcomes


@pytest.mark.usefixtures("short_scenes")
def test_a_fit_that_changes_nothing_has_the_runs_of_its_contender(monkeypatch: pytest.MonkeyPatch) -> None:
    base = load_config("simulated")
    saga = Contender.of(contenders("simulated")["saga"], base)
    shipped = LearnedInteractions(
        learned_from="", edges=base.tracker.edges, explained_noise=base.tracker.explained_noise
    )
    monkeypatch.setattr(fitted, "learn_interactions", lambda *recordings, **how: LearnedForms(shipped, {}, {}, (), {}))
    tracked = []

    def judged(source, names, compared, settings, workers, progress):  # type: ignore[no-untyped-def]
        tracked.extend(one.name for one in compared)
        return bench_gaps(source, names, compared, settings, workers, progress)

    monkeypatch.setattr(fitted, "bench_gaps", judged)
    source, settings = RecordingSource("simulated", scenes=2, labels=True), GapBenchSettings(0, ("kept",))
    split = [Split(("scene-0001",), ("scene-0002",))]
    runs = fitted.bench_splits(source, split, [saga], base, settings, ["edges"])
    assert tracked == ["saga"]
    assert [run.contender for run in runs] == ["saga", "saga, learned edges"]
    assert runs[0].outcomes == runs[1].outcomes


def test_scenes_without_truth_or_detections_are_refused() -> None:
    drawn = scene({"a": straight()}, {"a": straight()})
    with pytest.raises(InputError, match="scene drawn: expected ground truth"):
        LabelledScene.of(replace(drawn, ground_truth=None), {})
    with pytest.raises(InputError, match="scene drawn: expected detections"):
        LabelledScene.of(replace(drawn, frames=[]), {})


@pytest.mark.usefixtures("short_scenes")
def test_contenders_are_judged_on_the_same_gaps() -> None:
    base = load_config("simulated")
    source = RecordingSource("simulated", scenes=1)
    compared = [Contender.of(contenders("simulated")[name], base) for name in ("saga", "kf")]
    saga, kf = bench_gaps(source, ["scene-0001"], compared, GapBenchSettings(passes=1, lives=("kept",)))
    assert saga.gaps == kf.gaps
    assert len(saga.gaps) > 3
    figures = gap_figures([saga, kf], "kf")
    for ours, theirs in zip(figures[::2], figures[1::2], strict=True):
        assert (ours.contender, theirs.contender) == ("saga", "kf")
        assert (ours.gaps, ours.group, ours.length) == (theirs.gaps, theirs.group, theirs.length)
        assert np.isnan(ours.kept.low), "one recording has no interval"
        if ours.error_change is not None and ours.measured:
            assert ours.error_change.estimate == pytest.approx(ours.error.estimate / theirs.error.estimate - 1)


@pytest.mark.usefixtures("short_scenes")
def test_the_command_prints_tables_and_writes_figures(tmp_path: Path) -> None:
    own, out = tmp_path / "own.yaml", tmp_path / "gaps.json"
    own.write_text("tracker: {explained_noise: 0.5}\n")
    arguments = ["bench", "gaps", "--sets", "simulated", "--scenes", "1", "--passes", "1", "--life", "kept"]
    arguments += ["--situations", "--lengths", "2"]
    arguments += ["--contenders", "kf", "--contender", f"own:saga={own}", "--json", str(out)]
    arguments += ["--plot", str(tmp_path / "gaps.png")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "real gaps of 1 to 6 s" in result.output
    assert (tmp_path / "gaps.png").read_bytes().startswith(b"\x89PNG")
    figures = json.loads(out.read_text())["simulated"]
    assert figures["recordings"] == ["scene-0001"]
    assert {row["contender"] for row in figures["gaps"]} == {"kf", "own"}
    assert {row["life"] for row in figures["outcomes"]} == {"kept"}
    assert {row["length"] for row in figures["outcomes"] if row["run"]} == {2.0}
    assert "after 2 s, by situation" in result.output
    everything = next(row for row in figures["situations"] if row["situation"] == "all")
    assert everything["gaps"] + everything["lost"] == sum(row["run"] > 0 for row in figures["outcomes"]) / 2


def test_the_command_refuses_recordings_without_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = replace(SHORT, duration=1.0)
    monkeypatch.setattr(sources, "_set", lambda name, data, scenes, *_: simulated_set(scenes, settings=settings))
    arguments = ["bench", "gaps", "--sets", "simulated", "--scenes", "1", "--passes", "1", "--contenders", "kf"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "expected recordings with gaps, there is none" in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--contenders", "nobody"], "--contenders: unknown contender"),
        (["--contender", "own"], "expected NAME=FILE"),
        (["--against", "turn", "--contenders", "saga,kf"], "--against: unknown contender"),
        (["--contenders", "saga"], "add kf to --contenders or give another --against"),
        (["--viewpoint", "mast"], "--viewpoint: expected ngsim or openacc among --sets"),
        (["--longest", "20"], "--longest: expected ngsim or openacc among --sets"),
        (["--picture", "gap.jpg"], "gap.jpg: expected a name that ends in .png"),
        (["--test", "scene-0099"], "--test: unknown recording"),
        (["--train", "scene-0001", "--test", "scene-0001"], "in one of them only"),
        (["--train", "scene-0001", "--plot", "gaps.png"], "set simulated: expected recordings to judge"),
        (["--passes", "0", "--plot", "gaps.png"], "--plot: expected --passes of 1 or more"),
        (["--fit", "edge"], "--fit: expected some of noise, edges, boosted, got 'edge'"),
        (["--fit", "edges"], "--fit: expected --train or --folds"),
        (["--fit", "boosted", "--folds", "2", "--life", "shipped"], "--fit boosted: expected --life kept or both"),
        (["--of", "halting,red"], "--of: unknown situation 'red'"),
        (["--folds", "1"], "--folds: expected a number of 2 or more, or place, got '1'"),
        (["--lengths", "4"], "--lengths: expected some of 1, 2, 3, 5, got '4'"),
        (["--situations", "--life", "shipped"], "--situations: expected --life kept or both"),
        (["--sets", "foo"], "megvii, centerpoint, camera, kitti, simulated, ngsim, openacc, argoverse2, eth_ucy"),
    ],
)
def test_the_command_refuses(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["bench", "gaps", "--sets", "simulated", "--scenes", "1", *arguments])
    assert result.exit_code == 2
    assert message in result.output
