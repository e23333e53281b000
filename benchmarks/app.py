"""All benchmarks, as one command."""

from __future__ import annotations

from benchmarks.estimators_command import estimators
from benchmarks.fusion import fusion
from benchmarks.gaps_command import gaps
from benchmarks.joint_command import joint
from benchmarks.loops_command import loops
from benchmarks.metrics import metrics
from benchmarks.scaling import scaling
from benchmarks.service_command import service
from benchmarks.signals import signals
from benchmarks.slam_command import slam
from benchmarks.smoothing import smoothing
from benchmarks.speed_command import speed
from benchmarks.streaming import streaming
from benchmarks.synthetic import synthetic
from benchmarks.tracking_command import tracking
from pipelines.cli.console import new_command

app = new_command()

for command in (
    *(estimators, fusion, gaps, joint, loops, metrics, scaling, service),
    *(signals, slam, smoothing, speed, streaming, synthetic, tracking),
):
    app.command()(command)


@app.callback()
def benchmarks() -> None:
    """Measure: every figure is compared with a baseline in the same run."""
