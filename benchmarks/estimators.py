"""Every estimator against its baseline: the textbook on dense matrices, or GTSAM's own fixed-lag smoother.

Filters read all means and all per-node covariances after every frame; the fixed-lag smoothers all means of their window
and (ours only) the newest covariances; the batch smoothers all means and all per-node covariances of a recording.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from benchmarks.contenders import Contender, Filter, GtsamWindow, Ours, OurWindow, Textbook, dense
from benchmarks.estimator_figures import Criterion, Row, Soak, criteria, exponents
from benchmarks.flocks import Flock, Kind, flock
from benchmarks.measuring import environment, size_of, timed
from benchmarks.running_graph import drivers, endless_drivers, windows
from pipelines.process import one_thread, resident_memory
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.estimators import (
    BatchSmoother,
    BoundedKalmanFilter,
    Gaussian,
    IncrementalFilter,
    JointKalmanFilter,
    kalman_predict,
    kalman_update,
    rts_smooth,
)
from saga_fg.numerics.arrays import FloatArray
from saga_fg.settings import setting
from saga_fg.tracking import TrackerSettings

KINDS: tuple[Kind, ...] = ("connected", "components")
LAG = 5  # frames
TRACKER = "kalman, as in the tracker"  # with the bounds that the tracker has by default
WARM_UP = 3  # frames that are not counted
WHOLE = 100  # more nodes take the running graph seconds a frame
DENSE = INCREMENTAL = 300  # more nodes in one graph are hopeless for the textbook and for iSAM2
_COVARIANCES = 50  # more nodes take GTSAM's smoother seconds to tell its covariances


@dataclass(frozen=True)
class EstimatorBenchSettings:
    """Size of the benchmark."""

    sizes: tuple[int, ...] = setting((10, 50, 100, 300, 1000), "numbers of nodes")
    frames: int = setting(20, "largest number of frames that are timed in each case")
    seconds: float = setting(30.0, "time after which a case ends early, s")
    batch_frames: int = setting(200, "frames of the recording that the batch smoothers solve; 0 for none")
    batch_nodes: int = setting(100, "nodes of that recording")
    soak_frames: int = setting(10_000, "frames of the endurance run; 0 for none")
    soak_nodes: int = setting(100, "nodes of the endurance run")
    scenes: int = setting(20, "nonlinear scenes drawn from the model; 0 for none")
    seed: int = setting(0, "seed of the flocks")
    scene_frames: int = setting(40, "frames of each of these scenes")
    everything: bool = setting(False, "measure the hopeless cases too")

    def __post_init__(self) -> None:
        if not self.sizes or min(self.sizes) < 2:
            raise InputError(f"sizes: expected at least 2 nodes each, got {self.sizes}")
        if self.frames < 1 or self.batch_frames < 0 or self.soak_frames < 0 or self.seconds <= 0:
            raise InputError("frames, seconds: expected positive numbers")


@dataclass(frozen=True)
class EstimatorBench:
    """All that was measured; exponents: of the cost over the number of nodes, by contender and graph."""

    rows: tuple[Row, ...]
    soaks: tuple[Soak, ...]
    exponents: dict[str, float]
    criteria: tuple[Criterion, ...]
    settings: EstimatorBenchSettings
    environment: Mapping[str, str] = field(default_factory=environment)


def bench_estimators(settings: EstimatorBenchSettings, progress: Progress | None = None) -> EstimatorBench:
    """Measure everything, one case after the other."""
    rows: list[Row] = []
    soaks: list[Soak] = []
    cases = [*_filter_cases(settings), *_lag_cases(settings), *_batch_cases(settings)]
    cases += [*_running_cases(settings), *_soak_cases(settings)]
    with one_thread():
        for done, (name, case) in enumerate(cases):
            if progress is not None:
                progress(name, done, len(cases))
            for measured in case():
                if isinstance(measured, Soak):
                    soaks.append(measured)
                else:
                    rows.append(measured)
    return EstimatorBench(tuple(rows), tuple(soaks), exponents(rows), criteria(rows, soaks), settings)


Case = tuple[str, Callable[[], Sequence[Row | Soak]]]


def _filter_cases(settings: EstimatorBenchSettings) -> Iterator[Case]:
    for n in settings.sizes:
        for kind in KINDS:
            yield f"filters, {kind}, {n} nodes", partial(_filters, kind, n, settings)


def _filters(kind: Kind, n: int, settings: EstimatorBenchSettings) -> list[Row]:
    frames = settings.frames + WARM_UP
    scene = flock(kind, n, frames, settings.seed)
    contenders: dict[str, Filter] = {}
    if n <= DENSE or settings.everything:
        contenders["textbook"] = Textbook(scene)
    contenders["kalman"] = Ours(JointKalmanFilter(), scene)
    if kind == "connected":
        contenders["kalman, bounded"] = Ours(BoundedKalmanFilter(), scene)
        tracker = TrackerSettings()
        contenders[TRACKER] = Ours(JointKalmanFilter((), tracker.tolerance, tracker.max_component), scene)
    if kind == "components" or n <= INCREMENTAL or settings.everything:
        contenders["isam2"] = Ours(IncrementalFilter(), scene)
    race = _race(contenders, scene, settings)
    reference = contenders.get("textbook", contenders["kalman"])
    baseline = race.milliseconds.get("textbook", math.nan)
    return [
        Row(
            "filter",
            kind,
            n,
            name,
            race.milliseconds[name],
            race.milliseconds[name] / baseline,
            *_errors(contender.read(), reference.read()),
            race.anees[name],
            size_of(contender.estimator.snapshot()) if isinstance(contender, Ours) else math.nan,
        )
        for name, contender in contenders.items()
    ]


def _lag_cases(settings: EstimatorBenchSettings) -> Iterator[Case]:
    for n in settings.sizes:
        for kind in KINDS:
            if kind == "components" or n <= 100 or settings.everything:
                yield f"fixed lag, {kind}, {n} nodes", partial(_windows, kind, n, settings)


def _windows(kind: Kind, n: int, settings: EstimatorBenchSettings) -> list[Row]:
    scene = flock(kind, n, settings.frames + WARM_UP + LAG, settings.seed)
    ours, gtsams = OurWindow(LAG, scene), GtsamWindow(LAG, scene)
    race = _race({"fixed-lag": ours, "gtsam": gtsams}, scene, settings, warm_up=WARM_UP + LAG)
    _, covariances = ours.read()
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).ravel()
    window = [np.abs((a - b) / sigma) for a, b in zip(ours.window, gtsams.window, strict=True)]
    theirs = gtsams.covariances() if n <= _COVARIANCES else None
    baseline = race.milliseconds["gtsam"]
    mine = Row(
        "fixed lag",
        kind,
        n,
        "fixed-lag",
        race.milliseconds["fixed-lag"],
        race.milliseconds["fixed-lag"] / baseline,
        float(np.max(window)),
        float(np.mean(window)),
        math.nan if theirs is None else _relative(covariances, theirs),
        race.anees["fixed-lag"],
        size_of(ours.estimator.snapshot()),
    )
    return [Row("fixed lag", kind, n, "GTSAM's", baseline, 1.0), mine]


def _batch_cases(settings: EstimatorBenchSettings) -> Iterator[Case]:
    for kind in KINDS if settings.batch_frames else ():
        yield f"batch, {kind}, {settings.batch_nodes} nodes", partial(_batches, kind, settings)


def _batches(kind: Kind, settings: EstimatorBenchSettings) -> list[Row]:
    n = settings.batch_nodes
    scene = flock(kind, n, settings.batch_frames, settings.seed)
    textbook, baseline = _textbook_smoother(scene)
    ours: list[tuple[FloatArray, FloatArray]] = []
    milliseconds = timed(lambda: ours.extend(_batch_smoother(scene)))
    at = np.arange(4 * n).reshape(-1, 4)
    errors = []
    for (mean, covariances), reference in zip(ours, textbook, strict=True):
        blocks = reference.covariance[at[:, :, None], at[:, None, :]]
        errors.append(_errors((mean.reshape(-1, 4), covariances), (reference.mean.reshape(-1, 4), blocks)))
    largest, average, covariance = np.array(errors).T
    return [
        Row("batch", kind, n, "textbook", baseline, 1.0),
        Row(
            "batch",
            kind,
            n,
            "batch",
            milliseconds,
            milliseconds / baseline,
            float(largest.max()),
            float(average.mean()),
            float(covariance.max()),
        ),
    ]


def _batch_smoother(scene: Flock) -> list[tuple[FloatArray, FloatArray]]:
    smoother = BatchSmoother(likelihoods=False)
    smoother.add(scene.nodes, scene.means, scene.covariances)
    for frame in scene.frames:
        smoother.predict(frame.transition)
        smoother.update(frame.measurements)
    return [(moment.state, moment.covariance(scene.nodes)) for moment in smoother.smoothed()]


def _textbook_smoother(scene: Flock) -> tuple[list[Gaussian], float]:
    """Smoothed states of every moment, and the milliseconds that filter and smoother took."""
    filtered, predicted, transitions = [Gaussian(scene.means.ravel(), _block_diagonal(scene.covariances))], [], []
    milliseconds = 0.0

    def take(F: FloatArray, b: FloatArray, Q: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray) -> None:
        predicted.append(kalman_predict(filtered[-1], F, b, Q))
        filtered.append(kalman_update(predicted[-1], z, H, R)[0])
        transitions.append(F)

    for frame in scene.frames:
        milliseconds += timed(partial(take, *dense(frame)))
    smoothed: list[Gaussian] = []
    milliseconds += timed(lambda: smoothed.extend(rts_smooth(filtered, predicted, transitions)))
    return smoothed, milliseconds


def _running_cases(settings: EstimatorBenchSettings) -> Iterator[Case]:
    for n in settings.sizes:
        for kind in KINDS if n <= WHOLE else ():
            yield f"running graph, {kind}, {n} nodes", partial(drivers, kind, n, settings.frames)
    if settings.scenes:
        yield "nonlinear scenes", partial(windows, settings.scenes, settings.scene_frames, settings.seed)


def _soak_cases(settings: EstimatorBenchSettings) -> Iterator[Case]:
    few = max(2, settings.soak_nodes // 5)
    for kind in KINDS if settings.soak_frames else ():
        n = settings.soak_nodes if kind == "components" else few
        scene = flock(kind, n, 50, settings.seed)
        yield f"endurance, {kind}, {n} nodes", partial(_soak, "isam2", kind, n, settings, partial(_endless, scene))
    if settings.soak_frames:
        make = partial(endless_drivers, few)
        yield f"endurance, drivers, {few} nodes", partial(_soak, "drivers", "components", few, settings, make)


def _endless(scene: Flock) -> Callable[[int], None]:
    """The linear filter on the same frames over and over."""
    ours = Ours(IncrementalFilter(), scene)

    def step(k: int) -> None:
        ours.prepare(scene.frames[k % len(scene.frames)])
        ours.step()

    return step


def _soak(
    name: str, kind: Kind, n: int, settings: EstimatorBenchSettings, make: Callable[[], Callable[[int], None]]
) -> list[Soak]:
    """`make` gives a fresh filter, which takes frame k. Over the last tenth of the frames a young one, which is then
    between one and two tenths old, takes turns with the one that went all the way.
    """
    part = max(1, settings.soak_frames // 10)
    second, late = settings.soak_frames - 2 * part, settings.soak_frames - part
    old, young = make(), make()
    times: dict[str, list[float]] = {"young": [], "old": []}
    memory: tuple[list[float], list[float]] = ([], [])
    for k in range(settings.soak_frames):
        taken = [timed(partial(old, k)), timed(partial(young, k - second)) if k >= second else 0.0]
        if k >= late:
            times["old"].append(taken[0])
            times["young"].append(taken[1])
        if k >= late or part <= k < 2 * part:
            memory[k >= late].append(resident_memory())
    medians = float(np.median(times["young"])), float(np.median(times["old"]))
    held = float(np.median(memory[0] or memory[1])), float(np.median(memory[1]))
    return [Soak(name, kind, n, settings.soak_frames, medians, held)]


@dataclass(frozen=True)
class _Race:
    """Median milliseconds a frame, and ANEES, of each contender."""

    milliseconds: dict[str, float]
    anees: dict[str, float]


def _race(
    contenders: Mapping[str, Contender], scene: Flock, settings: EstimatorBenchSettings, warm_up: int = WARM_UP
) -> _Race:
    """All contenders, frame by frame in turn; the first frames are not counted."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    errors: dict[str, list[float]] = {name: [] for name in contenders}
    spent = 0.0
    for k, frame in enumerate(scene.frames):
        for name, contender in contenders.items():
            contender.prepare(frame)
            taken = timed(contender.step)
            spent += taken / 1e3
            if k < warm_up:
                continue
            times[name].append(taken)
            if isinstance(contender, Ours | Textbook):
                errors[name].append(_anees(frame.truth, *contender.read()))
        if k >= warm_up and spent > settings.seconds:
            break
    return _Race(
        {name: float(np.median(taken)) for name, taken in times.items()},
        {name: float(np.mean(each)) if each else math.nan for name, each in errors.items()},
    )


def _anees(truth: FloatArray, means: FloatArray, covariances: FloatArray) -> float:
    """Mean over nodes of e^T P^-1 e / d."""
    error = (truth - means)[:, :, None]
    square = np.swapaxes(error, 1, 2) @ np.linalg.solve(covariances, error)
    return float(square.mean() / truth.shape[1])


def _errors(
    read: tuple[FloatArray, FloatArray], reference: tuple[FloatArray, FloatArray]
) -> tuple[float, float, float]:
    """Largest and average difference of the means, in standard deviations; largest of the covariances, relative."""
    sigma = np.sqrt(np.diagonal(reference[1], axis1=1, axis2=2))
    difference = np.abs((read[0] - reference[0]) / sigma)
    return float(difference.max()), float(difference.mean()), _relative(read[1], reference[1])


def _relative(blocks: FloatArray, reference: FloatArray) -> float:
    """Largest relative difference of one of the matrices."""
    difference = np.linalg.norm(blocks - reference, axis=(1, 2))
    return float((difference / np.linalg.norm(reference, axis=(1, 2))).max())


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    n, d, _ = blocks.shape
    whole = np.zeros((n, d, n, d))
    whole[np.arange(n), :, np.arange(n)] = blocks
    return whole.reshape(n * d, n * d)
