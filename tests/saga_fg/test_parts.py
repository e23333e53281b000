"""Parts of a user's own: by object and by name, checked where they enter, and by their conformance tests."""

import importlib
import sys
import textwrap
from dataclasses import dataclass, replace

import numpy as np
import pytest

from data_tools.conformance import check_metric
from data_tools.evaluation import own_figures
from pipelines.config import TrackConfig
from pipelines.configuration import read_settings, write_settings
from saga_fg import (
    ConstantAcceleration,
    ConstantVelocity,
    Curvilinear,
    Detection,
    Detections,
    Frame,
    Sensor,
    Tracker,
    TrackerSettings,
)
from saga_fg.conformance import (
    check_association_cost,
    check_class_model,
    check_edge_rule,
    check_interaction,
    check_motion,
    check_provider,
    check_sensor,
)
from saga_fg.errors import InputError
from saga_fg.model.edge_rules import Following, Neighbours, Repulsion
from saga_fg.model.interactions import CarFollowing, SharedVelocity
from saga_fg.model.manoeuvres import CoordinatedTurn, Mixture
from saga_fg.model.nonlinear_interactions import SmoothDriver
from saga_fg.parts import offered
from saga_fg.tracking import AssociationSettings, ClassSettings
from tests.saga_fg.traffic_frames import columns

MINE = """
from dataclasses import dataclass
import numpy as np
from saga_fg import Sensor
from saga_fg.model.edge_rules import Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.settings import NonNegative, setting

@dataclass(frozen=True)
class Towless(SharedVelocity):
    def triples(self, nodes, target, source):
        raise KeyError("hitch")

@dataclass(frozen=True)
class Drag:
    drag: NonNegative = setting(0.3, "share of the velocity lost per second, 1/s")
    components = ("x", "y", "vx", "vy")

    @property
    def generator(self):
        return np.kron([[0.0, 1.0], [0.0, -self.drag]], np.eye(2))

    @property
    def diffusion(self):
        return np.kron(np.diag([0.0, 1.0]), np.eye(2))

@dataclass(frozen=True)
class Foggy(Sensor):
    fog: float = 0.02

    def detection_covariance(self, detections, origin, probability=None):
        R = super().detection_covariance(detections, origin, probability)
        away = 0.0 if origin is None else np.hypot(*(detections.boxes.position[:, :2] - origin).T)
        return R * (1 + self.fog * away)[:, None, None] if origin is not None else R

class Chain:
    interaction = SharedVelocity()

    def pairs(self, nodes):
        later = np.arange(1, len(nodes))
        return Pairs(later, later - 1, np.full(len(later), 0.5))

@dataclass(frozen=True)
class Never:
    sensor: str = "radar"

    def __call__(self, problem):
        return np.full((len(problem.tracks), len(problem.detections)), np.inf if problem.sensor == self.sensor else 0.0)

def alike(problem):
    return np.zeros((len(problem.tracks), len(problem.detections)))

class BySize:
    classes = ("car", "truck")

    def likelihood(self, boxes):
        long = 1 / (1 + np.exp(-(boxes.size[:, 0] - 6.0)))
        return np.stack([1 - long, long], axis=1)

class Breaks:
    interaction = SharedVelocity()

    def pairs(self, nodes):
        return 1 / 0

class BreaksIn(Sensor):
    def detection_covariance(self, detections, origin, probability=None):
        return np.full((len(detections), 4, 4), np.nan)

class Doubtless(Sensor):
    def probability(self, score, label):
        return np.full(len(score), 2.0)

class Idle:
    interaction = SharedVelocity()

    def pairs(self, nodes):
        return None

class Changing(Drag):
    __hash__ = None

@dataclass(frozen=True)
class Matrix(Drag):
    A: np.ndarray = None

def missing_key(problem):
    return {}["key"]

def no_numbers(problem):
    return [["a"] * len(problem.detections)] * len(problem.tracks)

def no_argument():
    return 0.0

def recall(scenes):
    true, found = (sum(map(len, each)) for each in zip(*scenes, strict=True))
    return {"recall": found / true}
"""


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    (tmp_path / "my_parts.py").write_text(MINE)
    info = tmp_path / "my_parts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-parts\nVersion: 1.0\n")
    points = """
        [saga_fg.motions]
        drag = my_parts:Drag
        [saga_fg.metrics]
        recall = my_parts:recall
        """
    (info / "entry_points.txt").write_text(textwrap.dedent(points))
    monkeypatch.syspath_prepend(str(tmp_path))
    offered.cache_clear()
    yield importlib.import_module("my_parts")
    sys.modules.pop("my_parts", None)
    offered.cache_clear()


def frames(sensor="lidar", label="car", size=(4.0, 2.0, 1.5), count=12):
    for k in range(count):
        x = 10.0 * k / 10
        seen = [Detection(label, (x, y, 1.0), size, 0.0, score=0.9) for y in (0.0, 20.0)]
        yield Frame(k / 10, sensor, Detections.of(seen))


def run(tracker, **kinds):
    return [columns(tracker.step(frame)) for frame in frames(**kinds)]


def configured(text):
    return read_settings(TrackConfig, text, "mine.yaml")


def test_a_part_in_yaml_is_the_object_in_python_and_is_written_back(mine, subtests):
    drag, tracker = mine.Drag(drag=0.5), TrackerSettings()
    cases = {
        "tracker: {classes: {default: {motion: {kind: 'my_parts:Drag', drag: 0.5}}}}": replace(
            tracker, classes={"default": ClassSettings(motion=drag)}
        ),
        "tracker: {classes: {default: {motion: {kind: drag, drag: 0.5}}}}": replace(
            tracker, classes={"default": ClassSettings(motion=drag)}
        ),
        "tracker: {classes: {default: {motion: drag}}}": replace(
            tracker, classes={"default": ClassSettings(motion=mine.Drag())}
        ),
        "tracker: {association: {costs: [{kind: 'my_parts:Never', sensor: lidar}]}}": replace(
            tracker, association=AssociationSettings(costs=(mine.Never("lidar"),))
        ),
        "tracker: {association: {costs: ['my_parts:alike']}}": replace(
            tracker, association=AssociationSettings(costs=("my_parts:alike",))
        ),
    }
    for text, expected in cases.items():
        with subtests.test(text):
            config = configured(text)
            assert config.tracker == expected
            assert read_settings(TrackConfig, write_settings(config)) == config
            assert run(Tracker(config.tracker)) == run(Tracker(expected))


def test_rules_and_sensors_by_name(mine):
    config = configured("tracker: {edges: [following: x]}".replace("[following: x]", "['my_parts:Chain']"))
    assert isinstance(config.tracker.edges[0], mine.Chain)
    assert type(read_settings(TrackConfig, write_settings(config)).tracker.edges[0]) is mine.Chain
    law = configured("tracker: {edges: [{kind: following, interaction: {kind: car_following}}]}")
    assert isinstance(law.tracker.edges[0].interaction, CarFollowing)
    text = "sensors: {default: {detection_probability: 0.7}, lidar: {kind: 'my_parts:Foggy', fog: 0.1}}"
    found = configured(text)
    assert found.sensors["lidar"] == mine.Foggy(detection_probability=0.7, fog=0.1)
    assert read_settings(TrackConfig, write_settings(found)) == found


def test_a_cost_forbids_pairs_and_one_of_zeros_changes_nothing(mine):
    never = TrackerSettings(association=AssociationSettings(costs=(mine.Never("lidar"),)))
    tracker = Tracker(never)
    run(tracker)
    assert min(tracker.assignment.id.tolist()) > 20, "each detection initiates a track of its own"
    zeros = replace(never, association=AssociationSettings(costs=("my_parts:alike",)))
    assert run(Tracker(zeros)) == run(Tracker())
    assert run(Tracker(never), sensor="camera") == run(Tracker(), sensor="camera")


def test_a_class_model_decides_the_class_of_a_track(mine):
    for length, label in ((4.0, "car"), (12.0, "truck")):
        tracker = Tracker(sensors={"lidar": Sensor(class_model=mine.BySize())})
        for frame in frames(size=(length, 2.0, 1.5)):
            tracks = tracker.step(frame)
        assert set(tracks.boxes.label.tolist()) == {label}


def test_what_breaks_in_a_prediction_is_named(mine, monkeypatch):
    tracker = Tracker(TrackerSettings(edges=(mine.Chain(),)))
    run(tracker)
    monkeypatch.setattr(mine.Chain, "pairs", mine.Breaks.pairs)
    with pytest.raises(InputError, match=r"edges\[0\] \(my_parts:Chain\): ZeroDivisionError"):
        tracker.predict([1.0])


def test_what_breaks_is_named(mine, subtests):
    with pytest.raises(InputError, match=r"edges\[0\] \(my_parts:Breaks\): ZeroDivisionError: division by zero"):
        run(Tracker(TrackerSettings(edges=(mine.Breaks(),)), {"lidar": Sensor()}))
    for part, message in [
        (
            "tracker: {classes: {a: {motion: 'my_parts:Chain'}}}",
            "tracker.classes.a.motion: expected a motion model with",
        ),
        ("tracker: {edges: ['my_parts:Drag']}", r"edges\[0\]: expected an edge rule .* it lacks interaction, pairs"),
        ("tracker: {edges: [{kind: chain}]}", r"edges\[0\].kind: got 'chain'"),
        ("tracker: {edges: ['my_parts:Gone']}", "my_parts:Gone: the module my_parts has no Gone"),
        ("tracker: {edges: [{kind: 'my_parts:Chain', rate: 1}]}", "my_parts:Chain: expected a dataclass"),
        ("sensors: {default: 'my_parts:Drag'}", "sensors.default: expected a sensor model derived from"),
        (
            "tracker: {classes: {a: {motion: {kind: drag, drag: x}}}}",
            "tracker.classes.a.motion.drag: expected a number",
        ),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=f"^mine.yaml: .*{message}"):
            configured(part)

    def flat(problem):
        return np.zeros(3)

    with pytest.raises(
        InputError, match=r"association.costs\[0\] \(.*flat\): expected numbers of shape \(2, 2\), got shape \(3,\)"
    ):
        run(Tracker(TrackerSettings(association=AssociationSettings(costs=(flat,)))))


def test_the_part_that_fails_is_named_also_beside_others_of_its_module(mine, subtests):
    def costs(*some):
        return replace(settings, association=AssociationSettings(costs=some))

    settings = TrackerSettings(classes={"default": ClassSettings(motion=mine.Drag())}, edges=(mine.Chain(),))
    for found, sensor, message in [
        (
            costs(mine.alike, mine.missing_key),
            Sensor(),
            r"association.costs\[1\] \(my_parts:missing_key\): KeyError: 'key'",
        ),
        (costs(mine.no_numbers), Sensor(), r"association.costs\[0\] \(.*\): ValueError: could not convert"),
        (costs(mine.no_argument), Sensor(), r"association.costs\[0\] \(.*\): TypeError: no_argument\(\) takes 0"),
        (
            replace(settings, edges=(mine.Breaks(), mine.Chain())),
            Sensor(),
            r"edges\[0\] \(my_parts:Breaks\): ZeroDivisionError",
        ),
        (replace(settings, edges=(mine.Idle(),)), Sensor(), "edge rule Idle: expected Pairs .* got NoneType"),
        (settings, mine.BreaksIn(), "BreaksIn.detection_covariance.*: expected a finite number"),
        (settings, mine.Doubtless(), "Doubtless.probability: expected numbers above 0 and below 1"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            run(Tracker(found, {"lidar": sensor}))
    with pytest.raises(InputError, match=r"interaction my_parts:Towless: KeyError: 'hitch'") as raised:
        TrackerSettings(edges=(Following(interaction=mine.Towless()),))
    assert isinstance(raised.value.__cause__, KeyError)
    with pytest.raises(InputError, match="motion: expected one that has a hash"):
        ClassSettings(motion=mine.Changing())
    with pytest.raises(InputError, match=r"a.motion: Matrix.A: .* has no YAML form"):
        configured("tracker: {classes: {a: {motion: 'my_parts:Matrix'}}}")


def test_a_module_that_ends_the_program_is_an_error_in_one_line(tmp_path):
    (tmp_path / "ends.py").write_text("raise SystemExit('two\\nlines')")
    with pytest.raises(InputError, match=r"ends cannot be imported: SystemExit: two lines$"):
        Tracker(TrackerSettings(estimator="ends:Filter"))


@pytest.mark.parametrize(
    ("check", "part"),
    [
        *((check_motion, each) for each in (ConstantVelocity(), ConstantAcceleration(), Curvilinear())),
        *((check_motion, each) for each in (CoordinatedTurn(), Mixture())),
        *((check_interaction, each) for each in (SharedVelocity(), CarFollowing(), SmoothDriver())),
        *((check_edge_rule, each) for each in (Following(), Neighbours(), Repulsion())),
        (check_sensor, Sensor()),
    ],
    ids=lambda each: type(each).__name__,
)
def test_the_toolkits_parts_conform(check, part):
    check(part)


def test_a_users_parts_conform(mine):
    check_motion(mine.Drag())
    check_sensor(mine.Foggy())
    check_edge_rule(mine.Chain())
    check_association_cost(mine.alike)
    check_class_model(mine.BySize())
    check_metric(mine.recall)


@dataclass(frozen=True)
class WrongSlope:
    """A nonlinear motion whose derivative is that of another."""

    components = ("x", "y", "vx", "vy")
    generator = np.diag([1.0, 1.0], k=2)
    diffusion = np.diag([0.0, 0.0, 1.0, 1.0])

    def flow(self, x, dt):
        return np.concatenate([x[..., :2] + dt * x[..., 2:], x[..., 2:]], axis=-1)

    def flow_jacobian(self, x, dt):
        return np.broadcast_to(np.eye(4), (*x.shape, 4))


@pytest.mark.parametrize(
    ("check", "part", "message"),
    [
        (check_motion, WrongSlope(), "flow_jacobian: expected the same within"),
        (check_motion, 3, "expected a motion model with components, generator, diffusion; it lacks"),
        (check_edge_rule, Following, "expected an edge rule with .* got the class Following, make it"),
        (
            check_association_cost,
            lambda p: np.zeros((1, 1)),
            r"costs: expected shape \(3, 5\), got \(1, 1\)",
        ),
        (
            check_association_cost,
            lambda p: np.arange(float(len(p.tracks) * len(p.detections))).reshape(len(p.tracks), -1),
            "order",
        ),
        (check_provider, 3, "expected a factor provider with name, factors"),
        (check_metric, lambda scenes: {}, "expected the same figures by name"),
        (
            check_metric,
            lambda scenes: {"id": float(len(scenes[0][1].id[0]))} if len(scenes[0][1]) else {"id": 0},
            "names",
        ),
    ],
)
def test_what_does_not_conform_is_said(check, part, message):
    with pytest.raises((AssertionError, InputError), match=message):
        check(part)


def test_a_metric_by_its_entry_point():
    assert own_figures([], ()) == {}
    with pytest.raises(InputError, match="unknown metric 'recal'; did you mean 'recall'"):
        own_figures([], ["recal"])
    with pytest.raises(InputError, match="metric: recall: "):
        own_figures([], ["recall"])  # no scene to unzip
    with pytest.raises(InputError, match="metric: <lambda>: expected figures by name, got float"):
        own_figures([], [lambda scenes: 1.0])
    with pytest.raises(InputError, match="metrics: expected a list"):
        own_figures([], "recall")
