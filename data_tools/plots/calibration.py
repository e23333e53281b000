"""Consistency of covariances: share of errors within the tracks' ellipses over the probability of the ellipses.

A class on the diagonal is right; above it the covariances are too large, below it too small. The grey bands are
those a class is judged by (`data_tools.metrics.error_summary`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from data_tools.metrics.error_summary import BANDS, calibration, errors_by_class
from data_tools.metrics.label_errors import LabelErrors
from saga_fg.numerics.chi_square import chi_square_quantile


def calibration_plot(errors: LabelErrors) -> Any:
    """A matplotlib `Figure` with a line for each class; classes with too few boxes to judge are dotted."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 6.0), layout="constrained")
    ax = figure.subplots()
    probability = np.linspace(0.01, 0.99, 99)
    ellipses = [chi_square_quantile(p, 2) for p in probability]
    for label, of_class in errors_by_class(errors).items():
        values = of_class.nees[np.isfinite(of_class.nees)]
        if len(values):
            share = np.searchsorted(np.sort(values), ellipses, side="right") / len(values)
            style = "-" if calibration(of_class).enough_data else ":"
            ax.plot(probability, share, style, label=f"{label} ({len(values)})", linewidth=1.4)
    ax.plot([0, 1], [0, 1], color="black", linewidth=0.8)
    for p, (low, high) in BANDS.items():
        ax.vlines(p, low, high, color="#bbbbbb", linewidth=6, zorder=0)
    ax.set(xlabel="probability of the ellipse", ylabel="share of errors within it", xlim=(0, 1), ylim=(0, 1.01))
    ax.grid(alpha=0.3)
    if len(ax.get_legend_handles_labels()[0]):
        ax.legend(frameon=False)
    return figure
