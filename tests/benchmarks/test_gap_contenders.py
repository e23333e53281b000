"""Who is compared in gaps, and what it was fitted to."""

from __future__ import annotations

import pytest

from benchmarks.gaps import fitted
from benchmarks.gaps.contenders import contenders
from benchmarks.gaps.fitted import Split, splits_of
from benchmarks.gaps.sources import RecordingSource
from benchmarks.gaps.summary import gap_figures, link_figures
from pipelines.config import Family, load_config
from pipelines.learning.gap_runs import LIFE, Contender, GapBenchSettings, bench_gaps, run_of, with_life
from pipelines.learning.interactions import LearnedForms
from saga_fg import InputError
from saga_fg.learning.gaps import real_gaps
from saga_fg.model.learned_interactions import LearnedInteractions
from saga_fg.model.motion import ConstantVelocity
from saga_fg.model.road.stopping import RedLight
from saga_fg.model.turning import CoordinatedTurn
from tests.pipelines.sampled_gaps import (
    HIDDEN,
    labelled,
    straight,
    without,
)


@pytest.mark.parametrize("family", ["nuscenes", "kitti", "simulated", "file"])
def test_contenders_and_lives_are_settings_of_every_kind_of_data(family: Family) -> None:
    base = load_config(family)
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
    assert contenders("kitti")["kf"].contender(base).same_as(Contender("classical", "kf", base))
    assert not contenders("kitti")["saga"].contender(base).same_as(Contender("classical", "kf", base))


def test_parts_of_the_graph_are_contenders_where_they_are_configured() -> None:
    base = load_config("heterogeneous")
    rules = contenders("heterogeneous")["without lights"].config(base).tracker.edges
    assert {type(rule) for rule in base.tracker.edges} - {type(rule) for rule in rules} == {RedLight}
    assert contenders("traffic")["without trails"].config(load_config("traffic")).tracker.traffic.reach == 0
    assert load_config("traffic").tracker.traffic.reach > 0


def test_a_hidden_car_is_followed_by_a_filter_that_is_kept_alive() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    kf = contenders("file")["kf"].contender(load_config("file"))
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
    kf = contenders("simulated")["kf"].contender(base)
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
    saga = contenders("simulated")["saga"].contender(base)
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
