"""The recall sweep of the nuScenes tracking metrics: what each class pays for more recall.

AMOTA and AMOTP are the means of the first and the last panel over the recall that is asked for; what is not reached
counts with 0 and with 2 m, and is left out of the curves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_tools.metrics.nuscenes_tracking import RecallCurves

_PANELS = {"motar": "MOTAR", "mota": "MOTA", "ids": "identity switches", "motp": "MOTP, m"}


def recall_sweep(curves: Mapping[str, RecallCurves]) -> Any:
    """A matplotlib `Figure` with a line for each class in every panel."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for ax, (name, title) in zip(axes, _PANELS.items(), strict=True):
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
