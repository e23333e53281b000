"""Journals of tracking, read back and explained track by track, and the clocks of sensors in words.

A journal lies beside the result it belongs to, `RESULT.journal.jsonl`, an event (`saga_fg.tracking.journal`) a line.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from data_tools.figures import FigureTable, count
from data_tools.files import atomic_file, open_bytes, parsed_json
from pipelines.config import Method, TrackConfig
from pipelines.tracking import OnlineTracker
from saga_fg.errors import InputError
from saga_fg.tracking import Event, Journal, SensorTime, of_scene

PAUSE = 3.0  # s, after which a relation to the same track is told of anew


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


def journal_of(result: Path) -> Path:
    """Return the path of a result's journal."""
    return result.with_name(f"{result.name}.journal.jsonl")


@contextmanager
def trackers(
    settings: TrackConfig, method: Method, scenes: Iterable[str], journal: Path | None
) -> Iterator[Callable[[], OnlineTracker]]:
    """Yield a function that makes a fresh tracker for each scene in turn; with a `journal`, one that writes it.

    Raises `InputError` for a journal of method centerpoint, which keeps none, or one that is not writable.
    """
    if journal is None:
        yield lambda: settings.new_tracker(method)
        return
    if method == "centerpoint":
        raise InputError("--explain: the method centerpoint keeps no journal")
    names = iter(scenes)
    with atomic_file(journal) as file:

        def write(event: Event) -> None:
            file.write(json.dumps(event, allow_nan=False).encode() + b"\n")

        yield lambda: settings.new_tracker(
            method, Journal(settings.of_method(method).tracker, of_scene(write, next(names)))
        )


def read_track(journal: Path, track: str, scene: str | None) -> tuple[list[Event], list[Event]]:
    """Read the events of one track, and those of the sensors' clocks in its scene.

    `track` is its number, or SCENE-NUMBER as in nuScenes results.

    Raises `InputError` for a journal that is not there or broken, a track that is not in it, or one that is in several
    scenes of which none is named.
    """
    if scene is None and "-" in track:
        scene, _, track = track.rpartition("-")
    if not track.isdecimal() or len(track) > 19:
        raise InputError(f"--track {track[:40]}: expected the number of a track, or SCENE-NUMBER")
    number = int(track)
    events, clocks, told = [], [], dict[tuple[int, str], float]()
    for event in read_events(journal):
        if event.get("event") == "clocks":
            clocks.append(event)
        elif event.get("track") == number and scene in (None, event.get("scene")):
            events.append(event)
        elif event.get("event") == "relations" and events and str(event.get("scene")) == str(events[-1].get("scene")):
            own = {(other, name): p for source, other, name, p in event["relations"] if source == number}
            new = {one: p for one, p in own.items() if event["time"] - told.get(one, -math.inf) > PAUSE}
            events += [event | {"track": number, "other": one, "p": p} for one, p in new.items()]
            told |= dict.fromkeys(own, event["time"])
    if not events:
        where = "" if scene is None else f" of scene {scene}"
        raise InputError(f"{journal}: expected events of track {number}{where}, there are none")
    scenes = sorted({str(event.get("scene")) for event in events})
    if len(scenes) > 1:
        raise InputError(f"--track {number}: expected --scene, the track is in {', '.join(scenes)}")
    return events, [event for event in clocks if str(event.get("scene")) == scenes[0]]


def clock_lines(events: Sequence[Event]) -> list[str]:
    """Return what is known of the sensors' clocks at the end of a scene, from its events of clocks, a line each."""
    lines = []
    for name, clock in (events[-1]["clocks"] if events else {}).items():
        since = next((e["time"] for e in events if e["clocks"].get(name, {}).get("corrected")), None)
        lines.append(clock_text(name, clock, since))
    return lines


def read_graphs(journal: Path) -> dict[str, list[Event]]:
    """Read the graphs of all frames, in order of time, by scene; none where there is no journal.

    Raises `InputError` for a broken one.
    """
    return _by_scene(journal, "graph")


def read_relations(journal: Path) -> dict[str, dict[float, list[list[Any]]]]:
    """Read right of way between tracks, by scene and time, s: rows of `Relations`; none where there is no journal.

    Raises `InputError` for a broken one.
    """
    found = _by_scene(journal, "relations")
    return {scene: {event["time"]: event["relations"] for event in events} for scene, events in found.items()}


def _by_scene(journal: Path, kind: str) -> dict[str, list[Event]]:
    events: dict[str, list[Event]] = {}
    for event in read_events(journal) if journal.exists() else ():
        if event.get("event") == kind:
            events.setdefault(str(event.get("scene")), []).append(event)
    return events


def read_events(journal: Path) -> Iterator[Event]:
    """Read all events. Raises `InputError` for a journal that is not there or broken."""
    if not journal.exists():
        raise InputError(f"{journal}: there is no journal; track with --explain to have one beside the result")
    with open_bytes(journal) as file:
        for number, line in enumerate(file, start=1):
            event = parsed_json(line, f"{journal}: line {number}")
            if not isinstance(event, dict):
                raise InputError(f"{journal}: line {number}: expected an event, got {str(event)[:40]}")
            if event.get("event") == "relations" and not _has_relations(event):
                wanted = "a time, and relations [[source, target, name, p], ...]"
                raise InputError(f"{journal}: line {number}: expected {wanted}")
            yield event


def _has_relations(event: Event) -> bool:
    rows = event.get("relations")
    if not isinstance(rows, list) or any(not isinstance(row, list) or len(row) != 4 for row in rows):
        return False
    if not all(isinstance(row[2], str) for row in rows):
        return False
    numbers = [event.get("time"), *(row[k] for row in rows for k in (0, 1, 3))]
    return all(isinstance(value, int | float) and math.isfinite(value) for value in numbers)


def story(events: Sequence[Event]) -> list[str]:
    """Return a track's history in lines of text; times from its first frame. Raises `InputError` for other events."""
    try:
        return _story(events)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise InputError(f"expected events as --explain writes them: {error!r:.80}") from error


def _story(events: Sequence[Event]) -> list[str]:
    first, last = events[0], events[-1]
    end = "" if last["event"] == "deleted" else ", then the recording ends"
    head = f"track {first['track']} of {first['scene']}, {first['label']}: {last['time'] - first['time']:.1f} s{end}"
    describe = {
        "initiated": _initiated,
        "matched": _matched,
        "missed": _missed,
        "deleted": _deleted,
        "unsettled": _unsettled,
        "relations": _relation,
    }
    lines = [head]
    for event in events:
        text, *more = describe[event["event"]](event)
        lines.append(f"{event['time'] - first['time']:8.2f} s  {event['sensor']:<8} {text}")
        lines += [f"{'':22}{line}" for line in more]
    return lines


def _initiated(event: Event) -> list[str]:
    near = event["nearest_tracks"]
    text = (
        f"initiated by detection {event['detection']}, probability {event['probability']:.2f} "
        f"(new tracks need {event['least_probability']:.2f}), which no track took"
    )
    if not near:
        return [text, f"there was no track of class {event['label']}"]
    sigmas = ", ".join(f"track {t['track']} {math.sqrt(t['distance2']):.1f}" for t in near)
    return [text, f"nearest tracks, in sigmas (gate {math.sqrt(event['gate']):.1f}): {sigmas}"]


def _matched(event: Event) -> list[str]:
    chosen, others = _split(event["candidates"])
    text = (
        f"kept: detection {chosen['detection']}, probability {chosen['probability']:.2f}, {chosen['metres']:.2f} m "
        f"from the prediction = {math.sqrt(chosen['distance2']):.1f} sigmas (gate {math.sqrt(chosen['gate']):.1f}); "
        f"{_existence(event)}"
    )
    return [text, *_others(others), *_edges(event)]


def _missed(event: Event) -> list[str]:
    _, others = _split(event["candidates"])
    nothing = [] if others else ["no detection of its class was near"]
    text = f"missed, not detected for {event['coasting']:.2f} s; {_existence(event)}"
    return [text, *nothing, *_others(others), *_edges(event)]


def _deleted(event: Event) -> list[str]:
    state = f"not detected for {event['coasting']:.2f} s, existence {event['existence']:.2f}"
    return [f"deleted: {event['reason']} ({state})"]


def _unsettled(event: Event) -> list[str]:
    deviation = " and ".join(f"{d:.2f}" for d in event["deviation"])
    return [f"not settled: the solver found no minimum of the graph; known to {deviation} m, no better than predicted"]


def _relation(event: Event) -> list[str]:
    other, name = event["other"]
    return [f"{name} track {other}, probability {event['p']:.2f}"]


def _split(candidates: Sequence[Event]) -> tuple[Event, list[Event]]:
    chosen: dict[str, Any] = next((c for c in candidates if c["outcome"] == "chosen"), {})
    return chosen, [c for c in candidates if c["outcome"] != "chosen"]


def _others(candidates: Sequence[Event]) -> list[str]:
    return [
        f"rejected: detection {c['detection']}, probability {c['probability']:.2f}, {math.sqrt(c['distance2']):.1f} "
        f"sigmas: {c['outcome']}"
        for c in candidates
    ]


def _edges(event: Event) -> list[str]:
    return [
        f"edge from track {edge['from']} ({edge['interaction']}, {edge['rate']:.2f}/s): moved the prediction by "
        f"{math.hypot(*edge['moved']):.3f} m, its velocity by {math.hypot(*edge['sped_up']):.3f} m/s"
        for edge in event["edges"]
    ]


def _existence(event: Event) -> str:
    before, after = event["existence"]
    return f"existence {before:.2f} -> {after:.2f}"
