"""Names of classes: which of ours a name of others means, and settings that meet no class or sensor of the data."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from difflib import get_close_matches

from data_tools.plausibility.doubt import FILL_IN, Doubt, Mend

_WORDS = {
    "pedestrian": "pedestrian pedestrians person people human walker adult child",
    "bicycle": "bicycle bicyclist bike cyclist cycle",
    "motorcycle": "motorcycle motorcyclist motorbike scooter moped",
    "trailer": "trailer semitrailer",
    "bus": "bus buses coach",
    "truck": "truck lorry hgv tractor",
    "car": "car cars vehicle sedan suv van taxi pickup auto automobile passenger",
    "barrier": "barrier fence wall guardrail",
}
_WORD_OF = {word: ours for ours, words in _WORDS.items() for word in words.split()}
_ORDER = tuple(_WORDS)  # a "vehicle.truck" is a truck, and a "vehicular_trailer" a trailer
_LARGE = re.compile(r"large|heavy")


def usual_class(name: str) -> str | None:
    """Our class that a name means, such as "car" for REGULAR_VEHICLE; None for a name that means none of them."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    found: set[str] = set()
    for text in (name, parted):
        found = found or {_WORD_OF[word] for word in re.findall(r"[a-z]+", text.lower()) if word in _WORD_OF}
    if "car" in found and _LARGE.search(name.lower()):
        found.add("truck")
    return next((ours for ours in _ORDER if ours in found), None)


def usual_classes(names: Iterable[str], known: Collection[str]) -> dict[str, str]:
    """For those of the names that are none of the `known` classes: the known one that they mean."""
    found = {name: usual_class(name) for name in names if name not in known}
    return {name: ours for name, ours in found.items() if ours is not None and ours in known}


def idle_rules(acting: Collection[str], classes: Collection[str]) -> Doubt | None:
    """Edge rules that act on classes (`acting`), none of which the objects have."""
    if not acting or not classes or set(acting) & set(classes):
        return None
    meant = usual_classes(sorted(classes), acting) or dict.fromkeys(sorted(classes), FILL_IN)
    what = (
        f"no edges: tracker.edges act on {', '.join(sorted(acting))}, and the tracks are of "
        f"{', '.join(sorted(classes))}; objects are tracked one by one"
    )
    expected = "name the classes as the rules do, or the rules' `classes` as the data"
    return Doubt("edges", what, expected, Mend(classes=meant))


def idle_lanes() -> Doubt:
    """Lanes of `tracker.road_map` where neither a class nor an edge rule reads lanes."""
    what = "tracker.road_map.lanes: no class follows them (motion.course_time), and no rule of tracker.edges reads them"
    return Doubt("lanes", what, "set course_time of a curvilinear motion, or add a rule such as in_lane")


def settings_without_data(where: str, set_up: Collection[str], there: Collection[str]) -> Doubt | None:
    """Settings at `where` for classes or sensors (`set_up`) that the data lack, while they have others without any."""
    idle, plain = sorted(set(set_up) - set(there)), sorted(set(there) - set(set_up))
    if not idle or not plain:
        return None
    nearest = get_close_matches(idle[0].lower(), [name.lower() for name in plain], n=1, cutoff=0.6)
    hint = next((name for name in plain if name.lower() == nearest[0]), plain[0]) if nearest else plain[0]
    what = f"{where}.{idle[0]} has settings and the data have none of it; {', '.join(plain[:6])} have the default ones"
    return Doubt(where, what, f"is {where}.{hint} meant?")
