"""The charts of a report as numbers, which the page draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_tools.metrics import LabelErrors, coverages, errors_by_class
from saga_fg.numerics.arrays import FloatArray

CURVE_POINTS = 100
FEWEST = 20  # errors that make a curve
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)


@dataclass(frozen=True)
class Series:
    """A curve, or the heights of bars; `faint`: the reference of the others."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    faint: bool = False


@dataclass(frozen=True)
class Chart:
    """Curves over common axes; with `bars`, the one series is drawn as bars from x[k] to x[k + 1]."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    bars: bool = False


def accuracy_charts(errors: LabelErrors) -> list[Chart]:
    """Return distributions of the errors at labels by class, and the shares that the tracks' ellipses hold."""
    classes = {name: of_class for name, of_class in errors_by_class(errors).items() if name != "overall"}
    charts = [
        distribution(
            f"{title} at labels",
            unit,
            "share of labels below",
            [(name, e.sample(field).values * scale) for name, e in classes.items()],
        )
        for title, unit, field, scale in (
            ("Position error", "m", "position", 1.0),
            ("Velocity error", "m/s", "velocity", 1.0),
            ("Heading error", "degrees", "heading", 180 / np.pi),
        )
    ]
    held = [Series("right", (0.0, 1.0), (0.0, 1.0), faint=True)]
    for name, of_class in classes.items():
        known = of_class.nees[np.isfinite(of_class.nees)]
        if len(known) >= FEWEST:
            held.append(Series(name, SHARES, list(coverages(known, SHARES).values())))
    charts.append(Chart("Calibration of positions", "share that the ellipse should hold", "share that it holds", held))
    return [chart for chart in charts if any(not series.faint for series in chart.series)]


def latency_chart(milliseconds: FloatArray) -> Chart:
    """Return the distribution of the tracker's time for a frame; milliseconds (N,), N > 0."""
    edges = np.histogram_bin_edges(milliseconds, bins=40, range=(0.0, float(np.percentile(milliseconds, 99.5)) or 1.0))
    counts, _ = np.histogram(np.minimum(milliseconds, edges[-1]), edges)
    median, p99 = np.percentile(milliseconds, [50, 99])
    title = f"Time in the tracker: median {median:.1f} ms a frame, 99 % within {p99:.1f} ms"
    return Chart(title, "ms", "frames", [Series("frames", edges.tolist(), counts.tolist())], bars=True)


def distribution(title: str, unit: str, share_of: str, samples: Sequence[tuple[str, FloatArray]]) -> Chart:
    """Return cumulative distributions up to the 99 % quantile, of the samples with enough values."""
    share = np.linspace(0.0, 0.99, CURVE_POINTS)
    series = [
        Series(name, np.quantile(values, share).tolist(), share.tolist())
        for name, values in samples
        if len(values) >= FEWEST
    ]
    return Chart(title, unit, share_of, series)
