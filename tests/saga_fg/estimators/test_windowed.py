"""The windowed smoother gives out what the batch smoother gives, while the recording is still going on."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Edges, NodeType, SceneGraph
from saga_fg.errors import InputError
from saga_fg.estimators import BatchSmoother, Measurements, WindowedSmoother, WindowSettings
from saga_fg.estimators.backward import future_influence
from saga_fg.estimators.recording import Recording
from saga_fg.model.discretisation import discretise
from tests.saga_fg.estimator_programs import random_program
from tests.saga_fg.random_graphs import CAR, CONE

SHORT = (0.02, 0.1, 0.2)


def streamed(program, settings):
    """All moments that come out, the largest number held, and how many came before the end."""
    smoother, out, held = WindowedSmoother(settings), [], 0
    for operation in program:
        operation.run(smoother)
        out += smoother.final()
        held = max(held, len(smoother._recording.epochs))
    early = len(out)
    bound = smoother.bound
    out += smoother.finish()
    return out, held, early, bound


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_what_is_final_is_what_the_batch_smoother_says(seed, tolerance):
    program = random_program(np.random.default_rng(seed), 100, kinds=(CAR, CONE), intervals=SHORT, density=0.2)
    batch = BatchSmoother(likelihoods=False, order="time")
    for operation in program:
        operation.run(batch)
    out, held, early, bound = streamed(program, WindowSettings(step=1.0, tolerance=tolerance))
    expected = batch.smoothed()
    assert len(out) == len(expected) == 100
    assert early > 30
    assert held < 90
    assert 0 < bound <= tolerance
    for mine, theirs in zip(out, expected, strict=True):
        assert mine.time == pytest.approx(theirs.time, abs=1e-9)
        assert mine.nodes.tolist() == theirs.nodes.tolist()
        np.testing.assert_allclose(mine.state, theirs.state, rtol=0, atol=tolerance)
        for node in mine.nodes.tolist():
            np.testing.assert_allclose(mine.covariance([node]), theirs.covariance([node]), rtol=0, atol=tolerance**2)


def platoon(length, hidden=(), seed=0, dt=0.1):
    """Predict and update calls over three cars that follow one another; car 2 is hidden in the frames `hidden`."""
    rng = np.random.default_rng(seed)
    car = NodeType("car", ConstantVelocity(acceleration_noise=0.5))
    S = np.tile(np.diag([0.0, 0.0, 1.0, 1.0]), (2, 1, 1))
    edges = Edges("following", [1, 2], [0, 1], [0.5, 0.5], -S, S, np.zeros((2, 4)))
    transition = discretise(SceneGraph.of([0, 1, 2], car, [edges]), dt)
    for k in range(length):
        seen = np.array([0, 1] if k in hidden else [0, 1, 2])
        z = np.column_stack([k * dt * 10 - 12 * seen, np.zeros(len(seen))]) + 0.1 * rng.normal(size=(len(seen), 2))
        yield transition, Measurements(seen, z, np.eye(2, 4), 0.01 * np.eye(2))


def begun(smoother):
    means = [[-12.0 * k, 0, 10, 0] for k in range(3)]
    smoother.add([0, 1, 2], means, np.tile(np.eye(4), (3, 1, 1)))
    return smoother


def drive(smoother, calls):
    """The largest number of moments between the newest one and the last that came out."""
    out, most = 0, 0
    for count, (transition, measurements) in enumerate(calls, start=1):
        smoother.predict(transition)
        smoother.update(measurements)
        out += len(smoother.final())
        most = max(most, count + 1 - out)
    return most


def test_what_is_held_does_not_grow_with_the_length():
    settings = WindowSettings(step=1.0)
    assert drive(begun(WindowedSmoother(settings)), platoon(150)) == drive(
        begun(WindowedSmoother(settings)), platoon(600)
    )


def test_a_hidden_object_is_waited_for_and_at_last_no_longer():
    step = 1.0
    seen = drive(begun(WindowedSmoother(WindowSettings(step))), platoon(200))
    hidden = drive(begun(WindowedSmoother(WindowSettings(step))), platoon(200, hidden=range(60, 120)))
    assert hidden > seen + 40
    impatient = begun(WindowedSmoother(WindowSettings(step, longest=4.0)))
    assert drive(impatient, platoon(200, hidden=range(60, 120))) <= 40 + 10 + 1
    assert impatient.bound > 1e-3


def test_the_influence_of_the_future_is_what_knowing_the_present_would_change():
    recording, batch, told = Recording(), BatchSmoother(order="time"), BatchSmoother(order="time")
    for smoother in (recording, batch, told):
        begun(smoother)
    for transition, measurements in platoon(30, hidden=range(10, 20)):
        for smoother in (batch, told):
            smoother.predict(transition)
            smoother.update(measurements)
    recording.restore(batch.snapshot().recording)
    told.update(Measurements([0, 1, 2], np.zeros((3, 4)), np.eye(4), 1e-12 * np.eye(4)))  # to know it exactly
    influence = list(future_influence(reversed(recording.steps)))[::-1]
    for moment, better, s in zip(batch.smoothed(), told.smoothed(), influence, strict=True):
        change = moment.covariance([0, 1, 2]) - better.covariance([0, 1, 2])
        np.testing.assert_allclose(s**2, np.diagonal(change, axis1=1, axis2=2).ravel(), rtol=1e-4, atol=1e-11)


def test_late_measurements_go_where_they_belong_or_are_refused():
    calls = list(platoon(100))
    settings = WindowSettings(step=1.0, late=1.2)
    smoother, batch = begun(WindowedSmoother(settings)), begun(BatchSmoother(order="time"))
    moments = []
    for k, (transition, measurements) in enumerate(calls):
        for one in (smoother, batch):
            one.predict(transition)
            if k % 10 != 5:
                one.update(measurements)
            elif k > 10:
                one.update(calls[k - 10][1], time=(k - 9) * 0.1 + 0.03)
        moments += smoother.final()
    assert len(moments) > 50
    moments += smoother.finish()
    for mine, theirs in zip(moments, batch.smoothed(), strict=True):
        np.testing.assert_allclose(mine.state, theirs.state, rtol=0, atol=1e-3)
    smoother = begun(WindowedSmoother(WindowSettings(step=1.0)))
    drive(smoother, calls)
    assert smoother.start > 5.0
    with pytest.raises(InputError, match="before what is remembered"):
        smoother.update(calls[0][1], time=0.1)


def test_settings_are_checked(subtests):
    for name in ["step", "tolerance", "longest"]:
        with subtests.test(name=name), pytest.raises(InputError, match=name):
            WindowSettings(**{name: 0.0})
