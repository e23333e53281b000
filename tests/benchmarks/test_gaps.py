"""The benchmark of gaps: who is compared, what is fitted to what, and its command from end to end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import gaps, recording_sets
from benchmarks.gap_picture import gap_picture, telling_gap
from benchmarks.gap_runs import GapBenchSettings, judged_run, prepared, real_gaps, run_of
from benchmarks.gaps import rows_of, split_runs, splits_of
from benchmarks.recording_sets import simulated_set
from benchmarks.variants import contenders, variants
from pipelines.config import Family, load_config
from pipelines.learning.gaps import LIFE
from pipelines.learning.interactions import LearnedForms
from saga_fg import InputError
from saga_fg.learning.gaps import situations_of
from saga_fg.model.stability import LearnedInteractions
from tests.pipelines.sampled_gaps import HIDDEN, SHORT, labelled, straight, without

SEVEN_SECONDS = replace(SHORT, duration=7.0)


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated scenes that last for seconds."""
    monkeypatch.setattr(recording_sets, "simulated_set", lambda scenes: simulated_set(scenes, settings=SEVEN_SECONDS))


def test_contenders_and_lives_are_settings_of_every_kind_of_data() -> None:
    families: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "file")
    for family in families:
        base = load_config(family)
        for variant in variants(family).values():
            made = variant.contender(base)
            config = made.kept_alive().config
            config.new_tracker(made.method)
            assert config.tracker.max_coasting == LIFE


def test_a_hidden_car_is_followed_by_a_filter_that_is_kept_alive() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    kf = variants("file")["kf"].contender(load_config("file"))
    found = real_gaps(drawn)
    kept, shipped = (run_of(drawn, found, kf, life) for life in ("kept", "shipped"))
    assert kept.outcomes[0].error < 0.5
    rows = [*rows_of("set", [kept], "kf", False, False), *rows_of("set", [shipped], "kf", False, False)]
    real = {title: row for title, row in rows if "real gaps" in title}
    alive, ended = real["set, tracks kept alive: real gaps of 1 to 6 s"], list(real.values())[1]
    assert (alive["identity kept"], ended["reported at the end"]) == (1.0, 0.0)
    assert [row["right"] for title, row in rows if "links" in title] == [1, 1]  # the second one is re-linked


def test_recordings_are_dealt(monkeypatch: pytest.MonkeyPatch) -> None:
    five = replace(simulated_set(5), clusters={"scene-0003": "scene-0001"})
    names = five.dataset.scenes
    assert splits_of(five, None) == [((), names)]
    first, second = splits_of(five, "2")
    assert first[1] == (names[0], names[2], names[3])
    assert second[1] == (names[1], names[4])
    assert [set(train) | set(test) for train, test in (first, second)] == [set(names)] * 2
    assert len(splits_of(five, "place")) == 4
    with pytest.raises(InputError, match="--folds 6: expected recordings for two folds or more, there are 4 units"):
        splits_of(five, "6")
    sites = ("USA_Lanker-1_10_T-1", "USA_Lanker-2_4_T-1", "USA_US101-1_1_T-1")
    dataset = type("Sites", (), {"scenes": sites})()
    assert [test for _, test in splits_of(replace(five, name="ngsim", dataset=dataset), "place")] == [
        sites[:2],
        sites[2:],
    ]


def test_contenders_are_fitted_to_the_recordings_that_teach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learning finds no interactions here: then saga is kf."""
    taught_by = []

    def learn(recordings, origin, base, *how):  # type: ignore[no-untyped-def]
        taught_by.append(origin)
        return LearnedForms(LearnedInteractions(learned_from=origin), {}, {}, (), {})

    monkeypatch.setattr(gaps, "learn_interactions", learn)
    base = load_config("simulated")
    kf = variants("simulated")["kf"].contender(base)
    source = simulated_set(2, settings=SEVEN_SECONDS)
    runs = split_runs(source, "2", ("noise", "edges"), [kf], base, GapBenchSettings(0, ("kept",)))
    assert taught_by == ["recordings scene-0002", "recordings scene-0001"]
    names = ["kf", "kf, fitted noise", "saga, learned edges"]
    assert [(run.recording, run.contender) for run in runs] == [
        (s, n) for s in ("scene-0001", "scene-0002") for n in names
    ]
    assert runs[0].outcomes == runs[2].outcomes


def test_gaps_may_be_of_some_situations_alone() -> None:
    settings = GapBenchSettings(1, ("kept",), (2.0,), of=("visible leader", "turning"))
    source = simulated_set(1, settings=SEVEN_SECONDS)
    traffic, found = prepared(source, "scene-0001", settings, load_config("simulated").sensors)
    made = [situations_of(traffic, gap)[2.0] for gap in found if gap.run > 0]
    assert made
    assert all(each & {"visible leader", "turning"} for each in made)


@pytest.mark.usefixtures("short_scenes")
def test_the_command_compares_on_the_same_gaps(bench, tmp_path: Path) -> None:
    own, picture = tmp_path / "own.yaml", tmp_path / "gap.png"
    own.write_text("tracker: {explained_noise: 0.5}\n")
    options = "gaps --sets simulated --scenes 1 --passes 1 --life kept --situations --lengths 2 --contenders kf"
    rows = bench(options, "--contender", f"own:saga={own}", "--picture", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    made = [row for row in rows if row["table"].endswith("made gaps")]
    assert {row["contender"] for row in made} == {"kf", "own"}
    for base, mine in zip(made[::2], made[1::2], strict=True):
        assert (base["contender"], mine["contender"]) == ("kf", "own")
        assert (base["objects"], base["gaps"]) == (mine["objects"], mine["gaps"])
        assert mine["relative change"]["estimate"] == pytest.approx(mine["error, m"] / base["error, m"] - 1)
        assert mine["relative change"]["low"] is None, "one recording has no interval"
    counts = [row for row in made if row["objects"].endswith(", 2 s") and row["contender"] == "kf"]
    (everything,) = [
        r for r in rows if r.get("objects") == "all" and r["contender"] == "kf" and "after 2 s" in r["table"]
    ]
    assert everything["gaps"] + everything["lost"] == sum(row["gaps"] for row in counts)


@pytest.mark.usefixtures("short_scenes")
def test_the_command_refuses(refused, subtests: pytest.Subtests) -> None:
    for arguments, message in [
        ("--contenders nobody", "--contenders: unknown name"),
        ("--contender own", "expected a new NAME=FILE"),
        ("--against turn --contenders saga,kf", "--against: unknown name"),
        ("--viewpoint mast", "--viewpoint: expected ngsim or openacc or crossings among --sets"),
        ("--longest 20", "--longest: expected ngsim or openacc or crossings among --sets"),
        ("--picture gap.jpg", "gap.jpg: expected a name that ends in .png"),
        ("--test scene-0099", "--test: unknown name"),
        ("--fit edge", "--fit: unknown name 'edge'"),
        ("--of halting,red", "--of: unknown name 'red'"),
        ("--folds 1", "--folds: expected a number of 2 or more, or place, got '1'"),
        ("--lengths 4", "--lengths: unknown name '4'"),
        ("--sets foo", "--sets: unknown name 'foo'"),
    ]:
        with subtests.test(arguments):
            assert message in refused(f"gaps --sets simulated --scenes 1 {arguments}")


def test_the_picture_shows_the_gap_that_tells_most() -> None:
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    found, base = real_gaps(drawn), load_config("file")
    pair = contenders("file", base, "centerpoint,kf", ())
    worse, better = ([run_of(drawn, found, one, life)] for one, life in zip(pair, ("shipped", "kept"), strict=True))
    assert telling_gap(better, worse) == ("drawn", found[0])
    figure = gap_picture(drawn, found[0], {one.name: judged_run(drawn, found, one, "kept") for one in pair})
    titles = [ax.get_title(loc="left").split(",")[0] for ax in figure.axes]
    assert titles == ["centerpoint: identity kept", "kf: identity kept"]
    with pytest.raises(InputError, match="--picture: expected recordings with gaps"):
        telling_gap([], [])
