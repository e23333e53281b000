"""`python -m benchmarks signals`: beliefs about traffic lights that nobody reports, against their recorded colours.

Lights count from the first moment at which a vehicle is first before one of their lines, at every frame. The prior is
the belief without traffic. From an even prior, the time is measured until a light is believed closed that is, since its
first vehicle stands or brakes.

With --left-out the settings of the inference are not those of the configuration: for each window they are the ones
among `CANDIDATES` with the least log-loss on all others that do not overlap with it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
import typer

from data_tools.datasets.ngsim.windows import NgsimWindows
from data_tools.datasets.overlapping import overlapping
from data_tools.datasets.recorded_traffic import PERIOD, RecordedTraffic
from data_tools.datasets.source import names
from data_tools.figures import FigureTable, cell
from data_tools.simulator.recorded_world import MAST, sensed_scene
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, report
from pipelines.config import TrackConfig, load_config
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import BoolArray, FloatArray
from saga_fg.types.signal import SignalSettings

SINCE = (0.0, 0.5, 1.0, 2.0, 4.0, np.inf)  # s since the first vehicle was there
BELIEFS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
SURE = 0.8  # belief that counts as believed
EVEN = 30.0  # s that all phases last in the even prior
CANDIDATES = ((0.1, 2.0), (0.05, 2.0), (0.2, 2.0), (0.1, 1.0), (0.1, 4.0))  # non_compliance and driver_noise


@dataclass(frozen=True, eq=False)
class BelievedLight:
    """One light of one window at its K frames: time since its first vehicle, s; belief in green; whether it was green;
    whether a first vehicle has stood or braked."""

    window: str
    since: FloatArray
    green: FloatArray
    truth: BoolArray
    held: BoolArray


def believed_lights(traffic: RecordedTraffic, config: TrackConfig) -> list[BelievedLight]:
    """Track a window whose lights nobody reports. Raises `InputError` for one without a map or colours."""
    if traffic.road_map is None or not traffic.colours:
        raise InputError(f"{traffic.name}: expected a map and the colours of its lights")
    tracker = config.new_tracker("saga")
    found: dict[str, list[tuple[float, float, bool, bool]]] = {}
    begun: dict[str, float] = {}
    held: set[str] = set()
    for frame in sensed_scene(replace(traffic, colours={}), MAST, None, seed=0).frames:
        tracker.step(frame)
        nodes, time = tracker.map_nodes, frame.timestamp  # type: ignore[union-attr]
        moment = min(round(time / PERIOD), len(traffic) - 1)
        for line, expected in zip(nodes.drivers.line.tolist(), nodes.drivers.expected, strict=True):
            light = nodes.light[-1 - line]
            begun.setdefault(light, time)
            if expected[0] <= 0 < expected[3]:  # at rest, or where it would have to brake
                held.add(light)
        for light, start in begun.items():
            shown = str(traffic.colours[light][moment])
            if shown:
                row = time - start, nodes.belief(light)["green"], shown == "green", light in held
                found.setdefault(light, []).append(row)
    return [BelievedLight(traffic.name, *map(np.array, zip(*rows, strict=True))) for rows in found.values()]


def left_out(found: Sequence[Sequence[BelievedLight]], unit: Mapping[str, str]) -> list[int]:
    """For each unit of windows, in order, the candidate of the least log-loss on the windows of all others.

    found  by candidate, the lights of all windows; unit: of each window

    Raises `InputError` for a single unit.
    """
    units = list(dict.fromkeys(unit.values()))
    if len(units) < 2:
        raise InputError("--left-out: expected windows that do not overlap, two at least")
    best = []
    for mine in units:
        others = [[light for light in lights if unit[light.window] != mine] for lights in found]
        losses = [
            log_loss(*(np.concatenate([getattr(one, name) for one in lights]) for name in ("green", "truth")))
            if lights
            else np.nan
            for lights in others
        ]
        best.append(int(np.nanargmin(losses)) if np.isfinite(losses).any() else 0)
    return best


def log_loss(belief: FloatArray, truth: BoolArray) -> float:
    """Mean of -log of the probability of what was the case."""
    chance = np.clip(np.where(truth, belief, 1 - belief), 1e-9, 1.0)
    return float(-np.log(chance).mean()) if len(chance) else float("nan")


def time_to_red(lights: Sequence[BelievedLight]) -> FloatArray:
    """Times, s, from the first vehicle that stands or would have to brake before a closed line until it is believed
    closed; inf where it never is."""
    times = []
    for light in lights:
        closed = light.held & ~light.truth
        if closed.any():
            start = int(np.argmax(closed))
            sure = np.flatnonzero(1 - light.green[start:] > SURE)
            times.append(light.since[start + sure[0]] - light.since[start] if len(sure) else np.inf)
    return np.array(times)


def tables(lights: Sequence[BelievedLight], even: Sequence[BelievedLight], prior: float) -> list[FigureTable]:
    """Log-loss by the time since the first vehicle, reliability, and how soon red is believed."""
    since, green, truth = (np.concatenate([getattr(each, n) for each in lights]) for n in ("since", "green", "truth"))
    rows = []
    for low, high in (*pairwise(SINCE), (0.0, np.inf)):
        mine = (since >= low) & (since < high)
        name = "all" if (low, high) == (0.0, np.inf) else f"{low:g} to {high:g} s"
        right = float(((green > 0.5) == truth)[mine].mean()) if mine.any() else float("nan")
        untold = np.full(int(mine.sum()), prior)
        figures = (log_loss(green[mine], truth[mine]), log_loss(untold, truth[mine]), right)
        rows.append((name, cell(int(mine.sum())), *(cell(each) for each in figures)))
    loss = FigureTable("Belief in green", ("since", "frames", "log-loss", "of the prior", "right"), tuple(rows))
    rows = []
    for low, high in pairwise(BELIEFS):
        mine = (green >= low) & ((green < high) | (high == 1.0))
        if mine.any():
            rows.append(
                (f"{low:g} to {high:g}", cell(int(mine.sum())), cell(green[mine].mean()), cell(truth[mine].mean()))
            )
    reliability = FigureTable("Reliability", ("belief", "frames", "mean", "was green"), tuple(rows))
    times = time_to_red(even)
    share = [float((times <= t).mean()) if len(times) else float("nan") for t in SINCE[1:-1]]
    title = f"Red believed ({SURE:g}) from an even prior, of {len(times)} lights"
    within = tuple((f"within {t:g} s", cell(each)) for t, each in zip(SINCE[1:-1], share, strict=True))
    soon = FigureTable(title, ("", "share"), within)
    return [loss, reliability, soon]


def signals(
    dataroot: Annotated[str, typer.Option("--dataroot", help="Folder of windows.csv.gz and maps.json.gz of NGSIM.")],
    scenes: Annotated[
        str | None, typer.Option("--scenes", help="Windows, with commas; all with lights if left out.")
    ] = None,
    chosen: Annotated[
        bool, typer.Option("--left-out", help="Choose the settings for each window on the other ones.")
    ] = False,
    config: Config = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Beliefs about traffic lights from who stops and who goes, where nobody reports their colours."""
    windows = NgsimWindows(dataroot, "signals")
    settings = load_config("traffic", config)
    own = settings.tracker.signals
    named = names("--scenes", scenes) if scenes else windows.names
    traffic = [one for one in map(windows.recording, named) if scenes or one.colours]
    unit = overlapping(traffic)
    tried = [
        replace(own, non_compliance=share, driver_noise=noise)
        for share, noise in (CANDIDATES if chosen else ((own.non_compliance, own.driver_noise),))
    ]

    def believed(one: RecordedTraffic, signal: SignalSettings) -> list[BelievedLight]:
        return believed_lights(one, replace(settings, tracker=replace(settings.tracker, signals=signal)))

    found = [[light for one in traffic for light in believed(one, signal)] for signal in tried]
    if not found[0]:
        raise InputError(f"{dataroot}: expected windows with vehicles before stop lines, there are none")
    best = dict.fromkeys(unit.values(), 0)
    if chosen:
        best = dict(zip(best, left_out(found, unit), strict=True))
    judged = [light for k, lights in enumerate(found) for light in lights if best[unit[light.window]] == k]
    even = [replace(each, red_duration=EVEN, amber_duration=0.1, green_duration=EVEN) for each in tried]
    from_even = [light for one in traffic for light in believed(one, even[best[unit[one.name]]])]
    shown = tables(judged, from_even, prior=float(own.stationary[2:].sum()))
    report(shown, {table.title: table.rows for table in shown}, json_file)
    if chosen:
        counts = Counter(best.values())
        said = (f"{CANDIDATES[k][0]:g} and {CANDIDATES[k][1]:g} for {n}" for k, n in counts.most_common())
        typer.echo(f"non_compliance and driver_noise chosen for {len(best)} windows: {', '.join(said)}")
