"""Files of settings."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import gtsam
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from factors import PlanarPose, RangeBearing
from pipelines.config import load_config
from pipelines.configuration import load_settings, read_settings, write_settings
from pipelines.serving.state import TreeWriter, read_tree
from saga_fg import Detection, Detections, Frame, SceneGraph
from saga_fg.errors import InputError
from saga_fg.estimators import GraphFilter, Measurements, Observations
from saga_fg.graph import OBJECT, GraphError, NewVariable, SceneFactorGraph
from saga_fg.graph.scene_factor_graph import GraphRecord
from saga_fg.model.discretisation import discretise
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from saga_fg.settings import setting, settings_group
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.traffic import SpeedPrior


@dataclass(frozen=True)
class GateSettings:
    probability: float = setting(0.99, "share of true detections the gate lets through")
    largest: int = setting(30, "detections considered for one track")

    def __post_init__(self) -> None:
        if not 0 < self.probability <= 1:
            raise InputError(f"probability: expected a number in (0, 1], got {self.probability}")


@dataclass(frozen=True)
class DistanceRule:
    kind: ClassVar[str] = "distance"
    scale: float = setting(10.0, "distance at which an edge is weak, m")


@dataclass(frozen=True)
class FollowingRuleSettings:
    classes: tuple[str, ...] = setting(("car", "truck"), "classes that follow each other")
    window: tuple[float, float] = setting((0.5, 40.0), "nearest and farthest gap, m")


Rule = DistanceRule | FollowingRuleSettings


@dataclass(frozen=True)
class ClassSettings:
    noise: float = setting(1.0, "acceleration noise")
    gate: GateSettings = settings_group(GateSettings, "the gate of this class")
    lifetime: float | None = setting(None, "s without detection until a track ends; null: never")


@dataclass(frozen=True)
class WholeSettings:
    """A settings tree with one of everything."""

    name: str = setting("saga", "what to call it")
    mode: Literal["greedy", "off", "hungarian"] = setting("hungarian", "how to assign")
    fast: bool = setting(False, "whether to hurry")
    gate: GateSettings = settings_group(GateSettings, "which detections may belong to a track")
    classes: Mapping[str, ClassSettings] = settings_group(
        lambda: {"default": ClassSettings(), "car": ClassSettings(noise=2.0)}, "one entry for each class"
    )
    rules: tuple[Rule, ...] = settings_group(lambda: (DistanceRule(),), "edge rules, in order")
    rates: Mapping[str, float] = settings_group(lambda: {"lidar": 20.0}, "rates, 1/s")
    rows: tuple[tuple[float, ...], ...] = setting(((1.0, 0.0), (0.0, 1.0)), "a matrix")
    fallback: GateSettings | None = setting(None, "a second gate")
    chosen: Rule = settings_group(DistanceRule, "one rule")


finite = st.floats(allow_nan=False)
words = st.text(st.characters(codec="utf-8"), max_size=20)
gates = st.builds(GateSettings, st.floats(1e-300, 1.0), st.integers(-(2**63) + 1, 2**63 - 1))
entries = st.builds(ClassSettings, finite, gates, st.none() | finite)
rules = st.builds(DistanceRule, finite) | st.builds(
    FollowingRuleSettings, st.lists(words).map(tuple), st.tuples(finite, finite)
)
wholes = st.builds(
    WholeSettings,
    words,
    st.sampled_from(["greedy", "off", "hungarian"]),
    st.booleans(),
    gates,
    st.dictionaries(words | st.sampled_from(["default", "car"]), entries, max_size=3),
    st.lists(rules, max_size=3).map(tuple),
    st.dictionaries(words, finite, max_size=2),
    st.lists(st.lists(finite, max_size=2).map(tuple), max_size=2).map(tuple),
    st.none() | gates,
    rules,
)


@given(wholes, st.booleans())
def test_round_trip_is_exact(settings, comments):
    text = write_settings(settings, comments)
    assert read_settings(WholeSettings, text) == settings


def test_every_default_is_printed_with_its_comment():
    expected = (
        "name: saga                      # what to call it\n"
        'mode: hungarian                 # how to assign (greedy | "off" | hungarian)\n'
        "fast: false                     # whether to hurry\n"
        "\n# which detections may belong to a track\n"
        "gate:\n"
        "  probability: 0.99  # share of true detections the gate lets through\n"
        "  largest: 30        # detections considered for one track\n"
        "\n# one entry for each class\n"
        "classes:\n"
        "  default:\n"
        "    noise: 1.0      # acceleration noise\n"
        "    # the gate of this class\n"
        "    gate:\n"
        "      probability: 0.99  # share of true detections the gate lets through\n"
        "      largest: 30        # detections considered for one track\n"
        "    lifetime: null  # s without detection until a track ends; null: never\n"
        "  car:\n"
        "    noise: 2.0\n"
        "    gate:\n"
        "      probability: 0.99\n"
        "      largest: 30\n"
        "    lifetime: null\n"
        "\n# edge rules, in order\n"
        "rules:\n"
        "  - kind: distance  # one of distance, following_rule\n"
        "    scale: 10.0     # distance at which an edge is weak, m\n"
        "\n# rates, 1/s\n"
        "rates:\n"
        "  lidar: 20.0\n"
        "rows: [[1.0, 0.0], [0.0, 1.0]]  # a matrix\n"
        "fallback: null                  # a second gate\n"
        "\n# one rule\n"
        "chosen:\n"
        "  kind: distance  # one of distance, following_rule\n"
        "  scale: 10.0     # distance at which an edge is weak, m\n"
    )
    assert write_settings(WholeSettings()) == expected


def test_a_partial_file_overrides_deeply_and_keeps_the_rest():
    text = """
    classes:
      car: {gate: {largest: 7}}
      pedestrian: {lifetime: 3}
      default: {noise: 1e-3}
    rules:
      - kind: following_rule
        window: [1, 2]
      - kind: distance
    chosen: {scale: 4}
    """
    settings = read_settings(WholeSettings, text)
    assert settings.classes["car"] == ClassSettings(noise=2.0, gate=GateSettings(largest=7))
    assert settings.classes["default"] == ClassSettings(noise=0.001)
    assert settings.classes["pedestrian"] == ClassSettings(noise=0.001, lifetime=3.0)  # starts from `default`
    assert settings.rules == (FollowingRuleSettings(window=(1.0, 2.0)), DistanceRule())
    assert settings.chosen == DistanceRule(scale=4.0)
    assert settings.gate == GateSettings()


def test_what_a_file_leaves_out_is_the_bases_and_null_takes_away(tmp_path):
    assert read_settings(WholeSettings, "classes: {car: null}").classes == {"default": ClassSettings()}
    path = tmp_path / "c.yaml"
    path.write_text("# nothing but a comment\n")
    assert load_settings(WholeSettings, path) == WholeSettings()
    base = WholeSettings(fast=True, gate=GateSettings(largest=3))
    settings = read_settings(WholeSettings, "gate: {probability: 0.5}", base=base)
    assert settings == WholeSettings(fast=True, gate=GateSettings(0.5, 3))


def test_written_floats_stay_floats_for_any_yaml_reader(subtests):
    for value in [1e-9, 1e22, 0.1, -0.0, float("inf"), 5e-324]:
        with subtests.test(value=value):
            text = write_settings(DistanceRule(scale=value), comments=False)
            read = yaml.safe_load(text)["scale"]
            assert isinstance(read, float)
            assert read == value


def test_aliases_that_stand_for_millions_of_entries_are_not_printed():
    lists = "".join(f"  - &l{k} [{', '.join([f'*l{k - 1}'] * 10) if k else 'lol'}]\n" for k in range(7))
    with pytest.raises(InputError) as caught:
        read_settings(WholeSettings, f"rules:\n- kind:\n{lists}", "my.yaml")
    assert str(caught.value) == "my.yaml: rules[0].kind: expected one of distance, following_rule, got a list"


def test_mistakes_are_one_line_errors(subtests):
    for text, message in [
        ("gate: {probabilty: 0.5}", "my.yaml: gate.probabilty: unknown key, did you mean 'probability'?"),
        ("gaet: {}", "my.yaml: gaet: unknown key, did you mean 'gate'?"),
        (
            "classes: {car: {gate: {xyz: 1}}}",
            "my.yaml: classes.car.gate.xyz: unknown key, expected one of probability, largest",
        ),
        ("gate: {probability: high}", "my.yaml: gate.probability: expected a number, got the text 'high'"),
        ("gate: {probability: true}", "my.yaml: gate.probability: expected a number, got true"),
        ("gate: {largest: 1.5}", "my.yaml: gate.largest: expected a whole number, got 1.5"),
        (f"gate: {{largest: {'9' * 4000}}}", f"my.yaml: gate.largest: expected a whole number, got {'9' * 40}"),
        (f"gate: {{probability: {'9' * 4000}}}", f"my.yaml: gate.probability: expected a number, got {'9' * 40}"),
        ("gate: " + "[" * 5000, "my.yaml: expected settings, this YAML is nested too deeply"),
        ("gate:\n" + "- " * 5000 + "1", "my.yaml: expected settings, this YAML is nested too deeply"),
        ("gate: {largest: true}", "my.yaml: gate.largest: expected a whole number, got true"),
        ("gate: {probability: 2}", "my.yaml: gate: probability: expected a number in (0, 1], got 2.0"),
        ("gate: 3", "my.yaml: gate: expected a section (key: value), got 3"),
        ("gate:", "my.yaml: gate: expected a section (key: value), got nothing (null)"),
        ("fast: 'yes'", "my.yaml: fast: expected true or false, got the text 'yes'"),
        ("name: 3", "my.yaml: name: expected text, got 3"),
        ("mode: hungaryan", "my.yaml: mode: expected one of greedy, off, hungarian, got the text 'hungaryan'"),
        ("mode: off", "my.yaml: mode: expected one of greedy, off, hungarian, got false"),
        ("rules: distance", "my.yaml: rules: expected a list, got the text 'distance'"),
        ("rules: [{scale: 3}]", "my.yaml: rules[0].kind: expected one of distance, following_rule, the key is missing"),
        ("rules: [{kind: distanc}]", "my.yaml: rules[0].kind: got 'distanc', did you mean 'distance'?"),
        (
            "rules: [{kind: following_rule, window: [1]}]",
            "my.yaml: rules[0].window: expected a list of 2, got 1 entries",
        ),
        ("rules: [{kind: distance, kernel: 1}]", "my.yaml: rules[0].kernel: unknown key, expected one of scale"),
        ("rates: {lidar: [1]}", "my.yaml: rates.lidar: expected a number, got a list"),
        ("classes: {1: {}}", "my.yaml: classes.1: expected a key that is text, got 1 (quote it)"),
        ("name: a\nname: b", "my.yaml: line 2: the key 'name' occurs twice in a section"),
        ("- 1", "my.yaml: the top level: expected a section (key: value), got a list"),
        ("name: 2020-02-31", "my.yaml: expected YAML: day is out of range for month"),
        ("gate: {", "my.yaml: expected YAML: line 1, column 8: expected the node content, but found '<stream end>'"),
    ]:
        with subtests.test(message):
            with pytest.raises(InputError) as caught:
                read_settings(WholeSettings, text, "my.yaml")
            assert str(caught.value) == message


def test_unreadable_files_and_types_without_a_form_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml: cannot be read: No such file"):
        load_settings(WholeSettings, tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9t\xe9\n")
    with pytest.raises(InputError, match=r"latin\.yaml: expected text in UTF-8"):
        load_settings(WholeSettings, tmp_path / "latin.yaml")

    @dataclass(frozen=True)
    class Odd:
        what: Any = setting(None, "anything")

    with pytest.raises(TypeError, match=r"Odd\.what"):
        write_settings(Odd())


def test_the_tables_of_the_site_name_every_key_with_default_type_and_meaning(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "docs")
    from settings_tables import settings_reference  # type: ignore[import-not-found]

    text = settings_reference(WholeSettings)
    assert "A settings tree with one of everything." in text
    assert '| `mode` | `hungarian` | `greedy` or `"off"` or `hungarian` | how to assign |' in text
    assert "## `classes.<name>`" in text
    assert "`classes.<name>.gate`: the same keys and defaults as `gate`." in text
    assert "## `rules[]`, kind `following_rule`" in text
    assert "`chosen`, kind `distance`: the same keys and defaults as `rules[]`, kind `distance`." in text
    assert "| `lifetime` | `null` | number, or `null` | s without detection until a track ends; null: never |" in text


# Trees of values: what comes back is what was written, whatever it is, and nothing else is made


def again(value: Any) -> Any:
    tree = TreeWriter(value)
    return read_tree(json.loads(json.dumps(tree.nodes)), bytes(tree.arrays))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=3) | st.integers(), inner, max_size=3)
    ),
    max_leaves=20,
)


def same(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return bool(a == b) and (not isinstance(a, float) or math.copysign(1, a) == math.copysign(1, b))


@given(VALUES)
def test_plain_values_come_back_with_their_types(value):
    assert same(again(value), value)


def test_what_is_shared_stays_shared_and_infinities_and_nan_come_back():
    low, high, none = again((-math.inf, math.inf, math.nan))
    assert (low, high) == (-math.inf, math.inf)
    assert math.isnan(none)
    shared = np.arange(3.0)
    first, (second,), scalar = again([shared, [shared], np.float64(2.5)])
    assert first is second
    assert type(scalar) is np.float64


ARRAYS: list[np.ndarray[Any, Any]] = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(24)[::3],
    np.array(["car", "bücher"]),
    np.empty((0, 3)),
    np.empty(0, dtype="<U1"),
    np.array([True, False]),
    np.array(3.5),
    np.array([np.nan, np.inf]),
]


def test_arrays_come_back_with_type_shape_and_order():
    for array in ARRAYS:
        back = again((1, array))[1]
        np.testing.assert_array_equal(back, array)
        assert (back.dtype, back.shape) == (array.dtype, array.shape)
        assert back.flags.f_contiguous == np.ascontiguousarray(array).flags.f_contiguous or array.flags.f_contiguous
        back[...] = back  # writeable, as it was
        array.flags.writeable = False
        assert not again(array).flags.writeable


def test_objects_are_made_again_by_their_constructors():
    settings = TrackerSettings(estimator="fixed-lag")
    assert again(settings.classes) == settings.classes
    assert again(ConstantVelocity(3.0)) == ConstantVelocity(3.0)
    expected = SpeedPrior(np.zeros(1), np.ones(1), np.ones(1))
    assert type(again(expected)) is SpeedPrior
    tree = TreeWriter(ConstantVelocity(3.0))
    tree.nodes[0] = -1.0
    with pytest.raises(InputError, match="acceleration_noise"):
        read_tree(tree.nodes, b"")


UNWRITTEN: list[list[Any]] = [
    [],
    [{"object": ["os", "system"], "parts": {}}],
    [{"object": ["pathlib", "Path"], "parts": {}}],
    [{"object": ["saga_fg.tracking.tracker", "np"], "parts": {}}],
    [{"object": ["saga_fg.tracking.tracker", "InputError"], "parts": {}}],
    [{"object": ["saga_fg.errors", "InputError"], "parts": {}}],
    [{"object": ["saga_fg.types.frame", "Frame.__init__"], "parts": {}}],
    [{"object": ["saga_fg.no_such_module", "Frame"], "parts": {}}],
    [{"list": [0]}],
    [1, {"list": [-1]}],
    [{"pickle": "gASV"}],
    [{"array": ["|O", [1], "C", True, 0]}],
    [{"array": ["<f8", [1000000000], "C", True, 0]}],
    [{"array": ["<f8", [-1], "C", True, 0]}],
    [{"array": ["<f8", [1], "C", True, -8]}],
    [1, {"graph": 0}],
    [1, {"method": [0, "residual"]}],
    [{"object": ["saga_fg.tracking.settings", "TrackerSettings"], "parts": {}}, {"method": [0, "__init__"]}],
]


def test_what_no_writer_writes_or_can_write_is_refused():
    for nodes in UNWRITTEN:
        with pytest.raises(InputError):
            read_tree(nodes, bytes(8))
    circle: list[Any] = []
    circle.append(circle)
    for value in (circle, object(), Path("x"), np.array([None]), {1, 2}, lambda: 0):
        with pytest.raises(InputError):
            TreeWriter(value)


def frame(k: float) -> Frame:
    rng = np.random.default_rng(int(2 * k))
    places = np.array([[8.0 * k / 10 + 12 * i, 3.0 * i, 0.0] for i in range(4)]) + rng.normal(0, 0.2, (4, 3))
    return Frame(k / 10, "lidar", Detections.of([Detection("car", (x, y, z)) for x, y, z in places.tolist()]))


@pytest.mark.parametrize(
    ("method", "estimator"), [("saga", "kalman"), ("kf", "kalman"), ("saga", "isam2"), ("saga", "fixed-lag")]
)
def test_a_tracker_goes_on_from_its_written_snapshot_to_the_last_bit(method, estimator):
    config = load_config("file")
    config = replace(config, tracker=replace(config.tracker, estimator=estimator))
    first, second = config.new_tracker(method), config.new_tracker(method)
    for k in range(12):
        first.step(frame(k))
    second.restore(again(first.snapshot()))
    for k in (12, 13, 11.5, 14, 15, 16):  # one of them late
        one, other = first.step(frame(k)), second.step(frame(k))
        np.testing.assert_array_equal(one.id, other.id)
        np.testing.assert_array_equal(one.boxes.position, other.boxes.position)
        np.testing.assert_array_equal(one.position_covariance, other.position_covariance)


CAR = NodeType("car", ConstantVelocity(0.5))
NODES = [1, 2, 3]


def drive(estimator: GraphFilter, seeds: range) -> GraphFilter:
    """Two cars that avoid each other, one who is alone; nonlinear and late measurements."""
    away = NonlinearEdges(SocialForce(), [0, 1], [1, 0], np.ones(2), np.zeros((2, 1, 4)))
    graph = SceneGraph(np.array(NODES), (CAR,) * 3, nonlinear=(away,))
    for seed in seeds:
        rng = np.random.default_rng(seed)
        estimator.predict(discretise(graph, 0.2))
        z = estimator.mean(NODES)[:, :2] + rng.normal(0, 0.1, (3, 2))
        estimator.update(Measurements(NODES, z, np.eye(2, 4), 0.01 * np.eye(2)))
        radar = RangeBearing(4, sensor_pose=(20.0, 0.0, 0.0))
        estimator.update(Observations([3], radar.predict(estimator.mean([3])), radar, 0.01 * np.eye(2)))
        late = estimator.time - (0.1 if estimator.lag else 0.0)
        estimator.update(Measurements([1], z[:1], np.eye(2, 4), np.eye(2)), time=late)
    return estimator


@pytest.mark.parametrize("lag", [0.0, 0.5])
def test_a_running_graph_goes_on_from_its_written_state(lag):
    first, second = (GraphFilter(lag=lag) for _ in range(2))
    first.add(NODES, [[0, 0, 1, 0], [2, 0.1, -1, 0], [9, 9, 0, 0]], np.stack([np.eye(4)] * 3))
    second.restore(again(drive(first, range(4)).snapshot()))
    for estimator in (first, second):
        drive(estimator, range(4, 8))
    np.testing.assert_array_equal(first.joint_mean(NODES), second.joint_mean(NODES))
    np.testing.assert_array_equal(first.joint_covariance(NODES), second.joint_covariance(NODES))


def record() -> GraphRecord:
    estimator = GraphFilter()
    estimator.add(NODES, np.zeros((3, 4)), np.stack([np.eye(4)] * 3))
    return GraphRecord.from_graph(estimator.graph())


def test_a_graph_whose_parts_do_not_fit_is_refused():
    sound = record()
    changes: list[tuple[dict[str, Any], str]] = [
        ({"elimination": "lu"}, "elimination"),
        ({"values": (np.zeros(3), *sound.values[1:])}, "expected a state"),
        ({"values": (np.full(4, np.nan), *sound.values[1:])}, "finite"),
        ({"variables": (sound.variables[0],) * 3}, "a key of its own"),
        ({"variables": (replace(sound.variables[0], id=7), *sound.variables[1:])}, "a key of its own"),
        ({"variables": (replace(sound.variables[0], type=PlanarPose()), *sound.variables[1:])}, "vector"),
        ({"groups": {0: replace(sound.groups[0], active=np.ones(2, dtype=bool))}}, "one truth value a row"),
        ({"variables": (), "base": (), "values": (), "births": ()}, "never added"),
    ]
    for change, message in changes:
        with pytest.raises(GraphError, match=message):
            replace(sound, **change).restored()


def test_factors_that_are_more_than_arrays_are_refused_by_name():
    graph = SceneFactorGraph()
    graph.advance(0.0)
    (key,) = graph.add_variables("start", [NewVariable(OBJECT, 1, np.zeros(2))])
    graph.add_factors("start", [gtsam.PriorFactorVector(key, np.zeros(2), gtsam.noiseModel.Unit.Create(2))])
    with pytest.raises(GraphError, match="provider start: PriorFactorVector: it can't be written to a file"):
        TreeWriter(graph)
