"""The clocks of a tracker's sensors for people: in words, and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from data_tools.figures import FigureTable, count
from saga_fg.tracking import SensorTime


def clock_text(name: str, clock: Mapping[str, Any], since: float | None = None) -> str:
    """The clock of a sensor, a `SensorTime` as JSON has it, in words; since: time of its first correction, s."""
    by = f"{clock['objects']} objects in common" if clock["objects"] else "the order of arrival"
    corrected = f", corrected by {-clock['corrected']:+.3f} s" if clock["corrected"] else ""
    if corrected and since is not None:
        corrected += f", first at {since:.3f} s"
    state = "" if clock["verdict"] == "used" else "; its frames are left out"
    return f"clock of {name}: {clock['offset']:+.3f} s (+- {clock['deviation']:.3f} s by {by}){corrected}{state}"


def clock_table(clocks: Mapping[str, Mapping[str, SensorTime]]) -> FigureTable:
    """A table of the sensors' clocks by scene, at the end of each."""
    columns = (
        *("sensor", "offset, s", "deviation, s", "corrected by, s", "drift, ms/s", "jitter, s", "objects in common"),
        "latest frame",
    )
    rows = []
    for scene, sensors in clocks.items():
        for name, each in sensors.items():
            times = (f"{each.offset:+.4f}", f"{each.deviation:.4f}", f"{-each.corrected:+.4f}")
            rates = (f"{1e3 * each.drift:+.3f}", f"{each.jitter:.4f}", count(each.objects), each.verdict)
            rows.append((f"{scene}: {name}" if len(clocks) > 1 else name, *times, *rates))
    return FigureTable("Clocks of the sensors", columns, tuple(rows))
