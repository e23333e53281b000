"""An estimator of a user's own: named by its module or an entry point, checked, and run by the tracker."""

import importlib
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from pipelines.configuration import read_settings
from saga_fg import InputError, Tracker, TrackerSettings
from saga_fg.conformance import check_estimator
from saga_fg.parts import offered
from saga_fg.tracking import EgoNodeSettings
from saga_fg.tracking.by_name import estimator_parameters
from tests.saga_fg.traffic_frames import columns, run, seen, straight

MINE = '''
"""Estimators of a user's own."""

import numpy as np
from scipy.linalg import block_diag

from saga_fg.errors import InputError
from saga_fg.estimators import BlockGaussian, Estimator, Gaussian, JointKalmanFilter, Measurements
from saga_fg.estimators import kalman_predict, kalman_update
from saga_fg.estimators.partition import StateLayout, checked_prior


class Textbook(Estimator):
    """A dense Kalman filter."""

    time = 0.0

    def __init__(self):
        self.layout = StateLayout()
        self.x = Gaussian(np.empty(0), np.empty((0, 0)))

    def add(self, nodes, means, covariances, labels=None):
        means, covariances = checked_prior(nodes, means, covariances)
        self.layout = self.layout.extended(nodes, means.shape[1])
        P = block_diag(self.x.covariance, *covariances)
        self.x = Gaussian(np.append(self.x.mean, means), P[len(P) - self.layout.size :])

    def predict(self, transition):
        if sorted(transition.nodes.tolist()) != sorted(self.layout.nodes.tolist()):
            raise InputError("transition: expected all nodes, and no others")
        at = self.layout.places(self.layout.rows(transition.nodes))
        before = Gaussian(self.x.mean[at], self.x.covariance[np.ix_(at, at)])
        F, Q = transition.F_matrix.toarray(), transition.Q_matrix.toarray()
        self.x = kalman_predict(before, F, transition.b, Q)
        self.layout = StateLayout(transition.nodes, transition.graph.dims)
        self.time += transition.dt

    def update(self, measurements, time=None):
        if not isinstance(measurements, Measurements):
            return sum(self.update(each) for each in measurements)
        rows = measurements.rows(self.layout)
        m, k, _ = measurements.H.shape
        if m == 0:
            return 0.0
        H = np.zeros((m * k, self.layout.size))
        for i, at in enumerate(self.layout.spans(rows)):
            H[i * k : (i + 1) * k, at] = measurements.H[i]
        self.x, likelihood = kalman_update(self.x, measurements.z.ravel(), H, block_diag(*measurements.R))
        return likelihood

    def marginalise(self, nodes):
        rows = np.setdiff1d(np.arange(len(self.layout)), self.layout.rows(nodes))
        at = self.layout.places(rows)
        self.x = Gaussian(self.x.mean[at], self.x.covariance[np.ix_(at, at)])
        self.layout = self.layout.select(rows)

    def posterior(self):
        return BlockGaussian.from_dense(self.layout.nodes, self.layout.dims, *self.x)


class Counting(JointKalmanFilter):
    """One of the toolkit's, with a change."""

    updates = 0

    def update(self, measurements, time=None):
        self.updates += 1
        return super().update(measurements, time)


def with_lag(lag, max_delay):
    made = Textbook()
    made.given = lag, max_delay
    return made


class Breaks(Textbook):
    def update(self, measurements, time=None):
        raise ZeroDivisionError("no gain")


class Needy(Textbook):
    def __init__(self, gain):
        super().__init__()


class Failing(Textbook):
    def __init__(self):
        raise RuntimeError("no licence")


class Halved(Textbook):
    posterior = Estimator.posterior
    marginalise = Estimator.marginalise


class Nothing:
    pass


number = 5
'''
TRUTH = straight([(0, 0), (-15, 0.3), (5, 40)], [(12, 0), (12, 0), (0, -9)])


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    """A module, and an installed package whose entry point names it."""
    (tmp_path / "my_estimators.py").write_text(MINE)
    (tmp_path / "my_broken.py").write_text("raise RuntimeError('not today')")
    (tmp_path / "mine-1.0.dist-info").mkdir()
    (tmp_path / "mine-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    points = """
        [saga_fg.estimators]
        textbook = my_estimators:Textbook
        gone = my_estimators:Gone
        """
    (tmp_path / "mine-1.0.dist-info" / "entry_points.txt").write_text(textwrap.dedent(points))
    monkeypatch.syspath_prepend(str(tmp_path))
    offered.cache_clear()
    yield importlib.import_module("my_estimators")
    sys.modules.pop("my_estimators", None)
    offered.cache_clear()


def frames(count=25):
    rng = np.random.default_rng(0)
    heading = [0.0, 0.0, -np.pi / 2]
    return seen(rng, TRUTH, np.arange(count) / 10, noise=0.1, yaw=heading, velocity=TRUTH(1) - TRUTH(0))


def settings(name, **values):
    return TrackerSettings(estimator=name, **({"tolerance": 0.0} | values))


def test_a_users_estimator_tracks_as_the_toolkits_do(mine):
    tracker, usual = Tracker(settings("textbook")), Tracker(settings("kalman"))
    assert isinstance(tracker._state.joint.estimator, mine.Textbook)
    for frame in frames():
        a, b = tracker.step(frame), usual.step(frame)
        assert a.id.tolist() == b.id.tolist()
        assert a.boxes.position == pytest.approx(b.boxes.position, abs=1e-8)
        assert a.position_covariance == pytest.approx(b.position_covariance, rel=1e-7)
    assert len(a) == 3
    assert np.abs(a.boxes.position[:, :2] - TRUTH(2.4)).max() < 0.3
    horizon = tracker.predict([1.0]), usual.predict([1.0])
    assert horizon[0].position == pytest.approx(horizon[1].position, abs=1e-6)
    assert len(list(tracker.running_graph.variables)) >= 3


def test_an_estimator_that_raises_is_named_and_a_step_that_fails_changes_nothing(mine, monkeypatch):
    tracker = Tracker(settings("my_estimators:Breaks"))
    with pytest.raises(InputError, match=r"estimator \(my_estimators:Breaks\): ZeroDivisionError: no gain"):
        run(tracker, frames(3))
    with pytest.raises(InputError, match=r"unknown estimator '', expected one of: kalman"):
        Tracker(settings(""))
    tracker, told = Tracker(settings("my_estimators:Textbook")), frames()
    run(tracker, told[:5])
    before = columns(tracker.tracks(told[4].timestamp))
    with monkeypatch.context() as broken:
        broken.setattr(mine.Textbook, "marginalise", lambda *_: 1 / 0)
        broken.setattr(mine.Textbook, "update", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            tracker.step(told[5])
    assert columns(tracker.tracks(told[4].timestamp)) == before


def test_a_subclass_is_what_runs(mine):
    tracker = Tracker(settings("my_estimators:Counting", tolerance=0.02, max_component=7))
    run(tracker, frames(3))
    estimator = tracker._state.joint.estimator
    assert isinstance(estimator, mine.Counting)
    assert estimator.updates > 0
    assert (estimator.bounds.tolerance, estimator.bounds.most) == (0.02, 7)


def test_it_is_called_with_the_settings_that_its_parameters_name(mine):
    tracker = Tracker(settings("my_estimators:with_lag", lag=3.5, max_delay=0.2))
    estimator = tracker._state.joint.estimator
    assert isinstance(estimator, mine.Textbook)
    assert estimator.given == (3.5, 0.2)
    assert estimator_parameters("my_estimators:with_lag") == {"lag", "max_delay"}
    assert estimator_parameters("kalman") == {"providers", "tolerance", "max_component"}
    assert estimator_parameters("isam2") == {"providers"}
    assert estimator_parameters("fixed-lag") == {"providers", "lag"}


def test_estimators_from_yaml_take_what_they_take():
    found = read_settings(TrackerSettings, "estimator: my_estimators:Textbook", "mine.yaml")
    assert found == replace(TrackerSettings(), estimator="my_estimators:Textbook")
    with pytest.raises(InputError, match=r"mine.yaml: unknown estimator 'textbok'; did you mean 'textbook'"):
        read_settings(TrackerSettings, "estimator: textbok", "mine.yaml")
    with pytest.raises(InputError, match="Textbook: expected no factor providers, it has no parameter `providers`"):
        Tracker(settings("my_estimators:Textbook", providers=("saga_fg.providers:Odometry",)))
    with pytest.raises(InputError, match=r"ego\.estimated: expected the estimator isam2 or fixed-lag, got my_est"):
        Tracker(settings("my_estimators:Textbook", ego=EgoNodeSettings(estimated=True)))


def test_one_line_says_what_is_wrong(subtests):
    for name, message in [
        (5, "expected an estimator that can be called, got int"),
        ("my_estimators:", "expected MODULE:NAME, got 'my_estimators:'"),
        (":Textbook", "expected MODULE:NAME"),
        (
            "nowhere:Textbook",
            "nowhere:Textbook: nowhere cannot be imported: ModuleNotFoundError: No module named 'nowhere'",
        ),
        ("my_broken:Any", "my_broken:Any: my_broken cannot be imported: RuntimeError: not today"),
        ("my_estimators:Gone", "my_estimators:Gone: the module my_estimators has no Gone"),
        ("gone", "gone of the package mine: the module my_estimators has no Gone"),
        ("my_estimators:number", "expected a class or a function, got int"),
        ("my_estimators:Needy", "expected parameters that are settings of the tracker, got gain"),
        ("my_estimators:Failing", "cannot be made without arguments: RuntimeError: no licence"),
        ("my_estimators:Halved", "lacks marginalise, posterior of saga_fg.estimators.Estimator"),
        ("my_estimators:Nothing", "Nothing: expected a class derived from saga_fg.estimators.Estimator, got <my"),
    ]:
        with subtests.test(message):
            with pytest.raises(InputError) as raised:
                Tracker(settings(name))
            assert str(raised.value).startswith("estimator: ")
            assert message in str(raised.value)
            assert "\n" not in str(raised.value)


def test_a_users_estimator_conforms(mine):
    check_estimator(mine.Textbook)


def test_the_check_names_what_differs(mine):
    def predict(self, transition):
        mine.Textbook.predict(self, transition)
        self.x = self.x._replace(mean=self.x.mean + 1e-6)

    sloppy = type("Sloppy", (mine.Textbook,), {"predict": predict})
    with pytest.raises(
        AssertionError, match=r"check_programs: operation \d+, Predict: joint_mean is off by .* standard"
    ):
        check_estimator(sloppy)
    with pytest.raises(AssertionError, match=r"check_methods: .*abstract class Halved .*marginalise.* posterior"):
        check_estimator(mine.Halved)
