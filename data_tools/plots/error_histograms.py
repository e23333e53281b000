"""How large errors at labels are: cumulative histograms of position, velocity and heading, class by class."""

from __future__ import annotations

from typing import Any

import numpy as np

from data_tools.metrics.error_summary import errors_by_class
from data_tools.metrics.label_errors import LabelErrors
from saga_fg.numerics.arrays import FloatArray

_PANELS = {
    "position": ("position, m", 1.5, 1.0),
    "velocity": ("velocity, m/s", 3.0, 1.0),
    "heading": ("heading, degrees", 180.0, 180.0 / np.pi),
}


def error_histograms(errors: LabelErrors) -> Any:
    """A matplotlib `Figure` with three panels; dashed in the first: the detections."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (name, (title, limit, scale)) in zip(axes, _PANELS.items(), strict=True):
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
