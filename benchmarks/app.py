"""All benchmarks that are run from a clone, as one command."""

from __future__ import annotations

from benchmarks.commands.association import association
from benchmarks.commands.bounded import bounded
from benchmarks.commands.coasting import coasting
from benchmarks.commands.fusion import fusion
from benchmarks.commands.heterogeneous import heterogeneous
from benchmarks.commands.lidar import lidar
from benchmarks.commands.metrics import metrics
from benchmarks.commands.occlusion import occlusion
from benchmarks.commands.paper import paper
from benchmarks.commands.reading import reading
from benchmarks.commands.scaling import scaling
from benchmarks.commands.smoothing import smoothing
from benchmarks.commands.streaming import streaming
from benchmarks.commands.synthetic import synthetic
from pipelines.cli.reporting import new_command

app = new_command()

for command in (
    association,
    bounded,
    coasting,
    fusion,
    heterogeneous,
    lidar,
    metrics,
    occlusion,
    paper,
    reading,
    scaling,
    smoothing,
    streaming,
    synthetic,
):
    app.command()(command)


@app.callback()
def benchmarks() -> None:
    """Measure: every figure is compared with a baseline in the same run."""
