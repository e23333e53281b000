"""Cost and accuracy of several methods over the number of objects, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Curve = Sequence[tuple[float, float, float]]
"""Of one method: number of objects, milliseconds a frame, error in m."""


def scaling_plot(curves: Mapping[str, Curve]) -> Any:
    """A matplotlib `Figure`: times on logarithmic axes to the left, errors to the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    cost, accuracy = figure.subplots(1, 2)
    for number, (name, curve) in enumerate(curves.items()):
        objects, milliseconds, errors = zip(*curve, strict=True)
        for ax, values in ((cost, milliseconds), (accuracy, errors)):
            # the first on top, and finer, so that one that agrees with it stays in sight
            ax.plot(objects, values, "o-", label=name, lw=1.2 + number, ms=3 + 2 * number, zorder=9 - number)
    cost.set(xscale="log", yscale="log", xlabel="objects", ylabel="CPU time a frame, ms")
    accuracy.set(xscale="log", xlabel="objects", ylabel="position RMSE of hidden objects, m")
    accuracy.set_ylim(bottom=0.0)
    for ax in (cost, accuracy):
        ax.grid(alpha=0.3)
    figure.legend(*cost.get_legend_handles_labels(), loc="outside lower center", ncols=len(curves), frameon=False)
    return figure
