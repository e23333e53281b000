"""Benchmarks of tracking."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import recording_sets
from benchmarks.gap_runs import ExtrapolatedRun, GapBenchSettings, Links, judgement, links, prepared, real_gaps, run_of
from benchmarks.gaps import rows_of
from benchmarks.recording_sets import Score, chosen_sets, simulated_set
from benchmarks.situations import situations_of
from benchmarks.tracking import changes
from benchmarks.variants import COMPONENTS, changed, contenders, variants
from data_tools.metrics import LabelErrors
from pipelines.cli import app as product
from pipelines.config import Family, load_config
from pipelines.learning.interactions import CAP, JudgedRun
from saga_fg import InputError
from saga_fg.learning.labelled_scene import Gap
from saga_fg.model.edge_rules import Following
from tests.pipelines.sampled_gaps import HIDDEN, SEEN, SHORT, TIMES, labelled, straight, tracks, without

SEVEN_SECONDS = replace(SHORT, duration=7.0)


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated scenes that last for seconds."""
    monkeypatch.setattr(recording_sets, "simulated_set", lambda scenes: simulated_set(scenes, settings=SEVEN_SECONDS))


def test_a_hidden_car_is_followed_by_a_filter_that_is_kept_alive():
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


def test_gaps_may_be_of_some_situations_alone():
    settings = GapBenchSettings(1, ("kept",), (2.0,), of=("visible leader", "turning"))
    source = simulated_set(1, settings=SEVEN_SECONDS)
    traffic, found = prepared(source, "scene-0001", settings, load_config("simulated").sensors)
    made = [situations_of(traffic, gap)[2.0] for gap in found if gap.run > 0]
    assert made
    assert all(each & {"visible leader", "turning"} for each in made)


@pytest.mark.usefixtures("short_scenes")
def test_the_command_compares_on_the_same_gaps(bench, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("tracker: {explained_noise: 0.5}\n")
    options = "gaps --sets simulated --scenes 1 --passes 1 --life kept --situations --lengths 2 --contenders kf"
    rows = bench(options, "--contender", f"own:saga={own}")
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


MADE = "ngsim or ngsim_without_road or openacc or dut or av2 or eth_ucy or crowds or crossings"


@pytest.mark.usefixtures("short_scenes")
def test_the_command_refuses(refused, subtests):
    for arguments, message in [
        ("--contenders nobody", "--contenders: unknown name"),
        ("--contender own", "expected a new NAME=FILE"),
        ("--against turn --contenders saga,kf", "--against: unknown name"),
        ("--viewpoint mast", f"--viewpoint: expected {MADE} among --sets"),
        ("--longest 20", f"--longest: expected {MADE} among --sets"),
        ("--test scene-0099", "--test: unknown name"),
        ("--of halting,red", "--of: unknown name 'red'"),
        ("--lengths 4", "--lengths: unknown name '4'"),
        ("--sets foo", "--sets: unknown name 'foo'"),
    ]:
        with subtests.test(arguments):
            assert message in refused(f"gaps --sets simulated --scenes 1 {arguments}")


# Which gaps there are, and how a run is judged on them


def test_a_real_gap_is_from_the_last_detection_to_the_next():
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


def test_a_duplicate_of_a_neighbour_is_no_detection_of_a_hidden_object():
    beside = straight(2.5)
    detections = {"a": without(straight(), HIDDEN), "b": beside, "ghost of b": straight(1.7)}
    assert [gap.row for gap in real_gaps(labelled({"a": straight(), "b": beside}, detections))] == [0]


def test_an_identity_is_kept_where_the_same_track_goes_on():
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    off = [x + (1.5 if k in HIDDEN else 0.0) for k, x in enumerate(straight())]
    judged = JudgedRun(drawn, tracks({"7": off}, {"7": SEEN}))
    outcome = judgement(judged, gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, True, True)
    assert outcome.error == pytest.approx(1.5)
    assert outcome.at == pytest.approx({1.0: 1.5, 2.0: 1.5})
    assert links(judged) == Links(right=1)


def test_a_track_that_ends_is_lost_and_costs_the_cap():
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(6, 16)), "8": without(straight(), range(9))}
    judged = JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN}))
    outcome = judgement(judged, gap)
    assert (outcome.held, outcome.kept, outcome.reported) == (True, False, False)
    assert outcome.error == pytest.approx(3 * CAP / 4), "still there at the first of four moments"
    assert links(judged) == Links()
    nobody = judgement(JudgedRun(drawn, tracks({}, {})), gap)
    assert (nobody.held, nobody.kept, nobody.reported, nobody.error) == (False, False, False, CAP)


def test_an_identity_may_be_handed_over_within_half_a_second_and_not_to_one_beside():
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": straight(), "8": without(straight(0.3), range(9))}
    old = [k < 5 for k in range(16)]
    assert not judgement(JudgedRun(drawn, tracks(places, {"7": old, "8": SEEN})), gap).kept
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    places = {"7": without(straight(), range(9, 10)), "8": without(straight(), [*range(9), *range(10, 16)])}
    assert judgement(JudgedRun(drawn, tracks(places, {"7": SEEN, "8": SEEN})), gap).kept
    later = {"7": without(straight(), range(9, 12)), "8": without(straight(), [*range(9), *range(12, 16)])}
    assert not judgement(JudgedRun(drawn, tracks(later, {"7": SEEN, "8": SEEN})), gap).kept


def test_a_track_that_goes_on_with_another_object_is_a_false_link():
    other = without(straight(4.0), range(9))
    labels = {"a": without(straight(), range(9, 16)), "b": other}
    drawn = labelled(labels, {"a": without(straight(), range(5, 16)), "b": other})
    place = [*straight()[:9], *straight(4.0)[9:]]
    judged = JudgedRun(drawn, tracks({"7": place}, {"7": SEEN}))
    assert links(judged) == Links(false=1)
    clutter = JudgedRun(drawn, tracks({"7": [*straight()[:9], *straight(40.0)[9:]]}, {"7": SEEN}))
    assert links(clutter) == Links(unknown=1)


def test_a_tracker_that_reports_nothing_unseen_is_extrapolated():
    drawn = labelled({"a": straight()}, {"a": without(straight(), HIDDEN)})
    (gap,) = real_gaps(drawn)
    found = tracks({"7": without(straight(), HIDDEN)}, {"7": SEEN})
    assert judgement(ExtrapolatedRun(drawn, found), gap).error == pytest.approx(0.0, abs=1e-9)
    assert judgement(JudgedRun(drawn, found), gap).error == CAP


# The tracking benchmark: variants by named settings, changes with intervals, and recordings

FAMILIES: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "file")


def test_every_component_is_a_setting_of_every_kind_of_data():
    for family in FAMILIES:
        base = load_config(family)
        found = contenders(family, base, ",".join(("saga", "kf", *(variant.name for variant in COMPONENTS))), ())
        assert all(one.config != base for one in found[2:]), "what changes nothing is left out"
        assert len({one.name for one in found}) == len(found) > 8


def test_settings_are_changed_by_their_dotted_names():
    base = load_config("nuscenes")
    every = changed(base, "tracker.classes.*.gate", 0.5)
    assert {each.gate for each in every.tracker.classes.values()} == {0.5}
    one = changed(base, "tracker.classes.car.gate", 0.5)
    assert one.tracker.classes["car"].gate == 0.5
    assert one.tracker.classes["default"] == base.tracker.classes["default"]
    without = variants("simulated")["without following"].contender(load_config("simulated")).config
    assert not any(isinstance(edge, Following) for edge in without.tracker.edges)
    for name in ("tracker.nothing", "tracker.classes.plane.gate", "tracker.report_coasting.more"):
        with pytest.raises(InputError, match="expected"):
            changed(base, name, 0.0)


def label_errors(velocity: float) -> LabelErrors:
    n = 5
    column = np.full(n, 1.0)
    fields = {"detection": column, "position": column, "heading": column, "nees": column}
    return LabelErrors(
        np.full(n, "car"), np.arange(n), column, np.ones(n, bool), velocity=np.full(n, velocity), **fields
    )


def test_changes_are_those_of_the_same_scenes():
    errors = tuple(label_errors(v) for v in (1.0, 2.0, 3.0))
    better = tuple(label_errors(0.5 * v) for v in (1.0, 2.0, 3.0))
    saga = Score(lambda rows: {"MOTA": 0.5 + 0.01 * sum(rows), "IDS": 2.0 * len(rows)}, better)
    kf = Score(lambda rows: {"MOTA": 0.4 + 0.01 * sum(rows), "IDS": 1.0 * len(rows)}, errors)
    for units in ([[0], [1], [2]], [[0, 2], [1]]):
        found = changes(saga, kf, units, 20)
        assert found["MOTA"].estimate == pytest.approx(0.1)
        assert found["MOTA"].low == pytest.approx(0.1)
        assert found["velocity RMSE"].estimate == pytest.approx(-0.5)
        assert found["IDS, relative"].estimate == pytest.approx(1.0)
        assert found["position RMSE"].low <= 0.0 <= found["position RMSE"].high
    assert changes(saga, kf, [[0, 1, 2]], 20) == {}


def test_recordings_are_chosen_by_name_and_mistakes_are_one_line(refused):
    (chosen,) = chosen_sets("simulated", None, 3, "scene-0003")
    assert (chosen.name, chosen.family, chosen.dataset.scenes) == ("simulated", "simulated", ("scene-0003",))
    with pytest.raises(InputError, match="--test: unknown name 'scene-0009'"):
        chosen_sets(None, None, 3, "scene-0009")
    for arguments, message in [("--sets moon", "--sets: unknown name 'moon'"), ("--sets kitti", "expected --data DIR")]:
        assert message in refused(f"tracking {arguments}")


def test_the_command_on_recordings_in_the_nuscenes_layout(bench, tmp_path):
    data = tmp_path / "data"
    (tmp_path / "short.yaml").write_text("duration: 4.0\nwarm_up: 5.0\n")
    root = data / "nuscenes"
    data.mkdir()
    options = ["-o", str(root), "--scenes", "2", "--config", str(tmp_path / "short.yaml")]
    assert CliRunner().invoke(product, ["simulate", *options]).exit_code == 0
    (root / "detections" / "lidar.json").rename(root / "detections" / "centerpoint_lidar.json")
    splits = root / "v1.0-mini" / "splits.json"
    splits.write_text(json.dumps({"lidar_centerpoint": ["scene-0001", "scene-0002"]}))
    rows = bench("tracking --sets centerpoint --no-components --draws 3", "--data", str(data))
    accuracy = {row["variant"]: row for row in rows if "AMOTA" in row and "ms / frame" in row}
    assert set(accuracy) == {"saga", "kf", "centerpoint"}
    assert accuracy["saga"]["AMOTA"] > 0.2
    (against,) = [row for row in rows if "changes from kf" in row["table"]]
    assert against["AMOTA"]["estimate"] == pytest.approx(accuracy["saga"]["AMOTA"] - accuracy["kf"]["AMOTA"])
