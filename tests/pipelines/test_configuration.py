"""Settings through YAML: exact both ways, deep overrides, and errors that name file, key and what was expected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pipelines.configuration import load_settings, read_settings, settings_reference, write_settings
from saga_fg.errors import InputError
from saga_fg.settings import setting, settings_group


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
def test_round_trip_is_exact(settings: WholeSettings, comments: bool) -> None:
    text = write_settings(settings, comments)
    assert read_settings(WholeSettings, text) == settings


def test_every_default_is_printed_with_its_comment() -> None:
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


def test_a_partial_file_overrides_deeply_and_keeps_the_rest() -> None:
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


def test_null_takes_an_entry_of_a_table_away() -> None:
    assert read_settings(WholeSettings, "classes: {car: null}").classes == {"default": ClassSettings()}


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("# nothing but a comment\n")
    assert load_settings(WholeSettings, path) == WholeSettings()


def test_settings_start_from_the_given_base() -> None:
    base = WholeSettings(fast=True, gate=GateSettings(largest=3))
    settings = read_settings(WholeSettings, "gate: {probability: 0.5}", base=base)
    assert settings == WholeSettings(fast=True, gate=GateSettings(0.5, 3))


def test_written_floats_stay_floats_for_any_yaml_reader(subtests: pytest.Subtests) -> None:
    for value in [1e-9, 1e22, 0.1, -0.0, float("inf"), 5e-324]:
        with subtests.test(value=value):
            text = write_settings(DistanceRule(scale=value), comments=False)
            read = yaml.safe_load(text)["scale"]
            assert isinstance(read, float)
            assert read == value


def test_aliases_that_stand_for_millions_of_entries_are_not_printed() -> None:
    lists = "".join(f"  - &l{k} [{', '.join([f'*l{k - 1}'] * 10) if k else 'lol'}]\n" for k in range(7))
    with pytest.raises(InputError) as caught:
        read_settings(WholeSettings, f"rules:\n- kind:\n{lists}", "my.yaml")
    assert str(caught.value) == "my.yaml: rules[0].kind: expected one of distance, following_rule, got a list"


def test_mistakes_are_one_line_errors(subtests: pytest.Subtests) -> None:
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
        (
            "mode: hungaryan",
            "my.yaml: mode: expected one of greedy, off, hungarian, got the text 'hungaryan'",
        ),
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


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: cannot be read: No such file"):
        load_settings(WholeSettings, tmp_path / "none.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9t\xe9\n")
    with pytest.raises(InputError, match=r"latin\.yaml: expected text in UTF-8"):
        load_settings(WholeSettings, tmp_path / "latin.yaml")


def test_a_type_without_a_yaml_form_is_a_programmers_error() -> None:
    @dataclass(frozen=True)
    class Odd:
        what: Any = setting(None, "anything")

    with pytest.raises(TypeError, match=r"Odd\.what"):
        write_settings(Odd())


def test_the_reference_names_every_key_with_default_type_and_meaning() -> None:
    text = settings_reference(WholeSettings)
    assert "A settings tree with one of everything." in text
    assert '| `mode` | `hungarian` | `greedy` or `"off"` or `hungarian` | how to assign |' in text
    assert "## `classes.<name>`" in text
    assert "`classes.<name>.gate`: the same keys and defaults as `gate`." in text
    assert "## `rules[]`, kind `following_rule`" in text
    assert "`chosen`, kind `distance`: the same keys and defaults as `rules[]`, kind `distance`." in text
    assert "| `lifetime` | `null` | number, or `null` | s without detection until a track ends; null: never |" in text
