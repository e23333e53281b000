"""Plots of metrics: errors at labels, calibration of covariances, the recall sweep of nuScenes tracking."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_tools.metrics.label_errors import BANDS, LabelErrors, calibration, errors_by_class
from data_tools.metrics.nuscenes_sweep import RecallCurves
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.gating import chi_square_quantile

_ERRORS = {
    "position": ("position, m", 1.5, 1.0),
    "velocity": ("velocity, m/s", 3.0, 1.0),
    "heading": ("heading, degrees", 180.0, 180.0 / np.pi),
}
_CURVES = {"motar": "MOTAR", "mota": "MOTA", "ids": "identity switches", "motp": "MOTP, m"}


def error_histograms(errors: LabelErrors) -> Any:
    """Return a matplotlib `Figure` of cumulative histograms by class; dashed in the first panel: the detections."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (name, (title, limit, scale)) in zip(axes, _ERRORS.items(), strict=True):
        for number, (label, of_class) in enumerate(errors_by_class(errors).items()):
            _cumulative(ax, scale * of_class.sample(name).values, limit, color=f"C{number}", label=label)
            if name == "position":
                _cumulative(ax, of_class.sample("detection").values, limit, color=f"C{number}", linestyle="--")
        ax.set(xlabel=f"error of {title}", xlim=(0, limit), ylim=(0, 1))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("share of labels with an error up to this")
    if len(axes[0].lines):
        axes[0].legend(frameon=False)
    return figure


def _cumulative(ax: Any, values: FloatArray, limit: float, **style: Any) -> None:
    if len(values):
        edges = np.linspace(0, limit, 200)
        ax.plot(edges, np.searchsorted(np.sort(values), edges, side="right") / len(values), linewidth=1.4, **style)


def calibration_plot(errors: LabelErrors) -> Any:
    """Return a matplotlib `Figure` of the share of errors within the ellipses over the probability of the ellipses.

    A line for each class; classes with too few boxes to judge are dotted. On the diagonal the covariances are right,
    above it too large, below it too small; the grey bands are those that classes are judged by
    (`data_tools.metrics.label_errors`).
    """
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


def recall_sweep(curves: Mapping[str, RecallCurves]) -> Any:
    """Return a matplotlib `Figure` of what each class pays for more recall, a line for each class in every panel.

    AMOTA and AMOTP are the means of the first and the last panel over the recall that is asked for; recall that is not
    reached counts with 0 and with 2 m, and is left out of the curves.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for ax, (name, title) in zip(axes, _CURVES.items(), strict=True):
        for label, curve in curves.items():
            values = getattr(curve, name)
            reached = np.isfinite(values) & np.isfinite(curve.score)
            ax.plot(curve.hypothetical_recall[reached], values[reached], label=label, linewidth=1.4)
        ax.set(title=title, xlim=(0, 1))
        ax.grid(alpha=0.3)
    for ax in axes[2:]:
        ax.set_xlabel("recall")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure
