"""All benchmarks that are run from a clone, as one command."""

from __future__ import annotations

from benchmarks.fusion import fusion
from benchmarks.metrics import metrics
from benchmarks.scaling import scaling
from benchmarks.settling import settling
from benchmarks.signals import signals
from benchmarks.smoothing import smoothing
from benchmarks.streaming import streaming
from benchmarks.synthetic import synthetic
from pipelines.cli.console import new_command

app = new_command()

for command in (fusion, metrics, scaling, settling, signals, smoothing, streaming, synthetic):
    app.command()(command)


@app.callback()
def benchmarks() -> None:
    """Measure: every figure is compared with a baseline in the same run."""
