"""`saga-fg bench`: benchmarks that print ratios to a baseline measured in the same run."""

from __future__ import annotations

import typer

from pipelines.cli.bench_estimators import estimators
from pipelines.cli.bench_gaps import gaps
from pipelines.cli.bench_joint import joint
from pipelines.cli.bench_loops import loops
from pipelines.cli.bench_service import service
from pipelines.cli.bench_slam import slam
from pipelines.cli.bench_speed import speed
from pipelines.cli.bench_tracking import tracking
from pipelines.cli.console import ReportingGroup

bench_app = typer.Typer(cls=ReportingGroup, no_args_is_help=True, rich_markup_mode=None)

for command in (estimators, gaps, joint, loops, service, slam, speed, tracking):
    bench_app.command()(command)


@bench_app.callback()
def bench() -> None:
    """Measure saga-fg beside baselines in the same run. Official figures of a dataset: `saga-fg benchmark`."""
