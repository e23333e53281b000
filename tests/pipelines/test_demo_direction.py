"""The direction of the demonstration's comparison, on fixed seeds: `saga` is at least as good in every column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from data_tools.metrics import SceneMetrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.demo import METHODS, compare

LENGTH = 8.0  # s
SEEDS = range(6)


@pytest.fixture(scope="module")
def metrics() -> Mapping[str, SceneMetrics]:
    """Pooled over one scene of each seed."""
    config, settings = load_config("simulated"), replace(SimulatorSettings(), duration=LENGTH)
    found = [compare(SimulatedTraffic(settings, 1, seed), config, METHODS).metrics for seed in SEEDS]
    return {method: SceneMetrics.pool(each[method] for each in found) for method in METHODS}


@pytest.mark.parametrize("other", ["centerpoint", "kf"])
def test_saga_is_at_least_as_good_in_every_column(metrics: Mapping[str, SceneMetrics], other: str) -> None:
    saga, baseline = metrics["saga"], metrics[other]
    assert saga.mota >= baseline.mota
    assert saga.switches <= baseline.switches
    assert saga.carried.rmse <= baseline.carried.rmse
    assert saga.velocity.rmse <= 1.01 * baseline.velocity.rmse  # as good, to a hundredth
    assert saga.position.median <= baseline.position.median
    assert saga.position.rmse <= 1.05 * baseline.position.rmse  # one wrong pair in six short scenes is 5 %
