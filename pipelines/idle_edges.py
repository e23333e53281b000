"""Edge rules that act on no class of the data: objects are tracked one by one, which the user should know."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from saga_fg.model.edge_rules import EdgeRule
from saga_fg.types.track import Tracks

log = logging.getLogger(__name__)

FRAMES = 100  # with tracks, after which a live stream is judged


class IdleEdges:
    """Notes the classes of tracks, and warns once if there are edge rules but none acts on any of them."""

    def __init__(self, rules: Iterable[EdgeRule]) -> None:
        self._acting = {label for rule in rules for label in getattr(rule, "classes", getattr(rule, "attached", ()))}
        self._classes: set[str] = set()
        self._frames = 0
        self._warned = False

    def add(self, classes: Iterable[str]) -> None:
        """Note classes of tracks."""
        self._classes.update(classes)

    def watch(self, tracks: Tracks) -> None:
        """Note the tracks of a live frame, and warn after `FRAMES` of them."""
        if self._warned or self._frames > FRAMES or not len(tracks):
            return
        self.add(tracks.boxes.label.tolist())
        self._frames += 1
        if self._frames > FRAMES:
            self.warn()

    def warn(self) -> None:
        """Warn, unless an edge rule acts on a class of the tracks, or there are no rules or no tracks."""
        if self._warned or not self._acting or not self._classes or self._acting & self._classes:
            return
        self._warned = True
        text = "no edges: tracker.edges act on %s, and the tracks are of %s; objects are tracked one by one"
        log.warning(text, ", ".join(sorted(self._acting)), ", ".join(sorted(self._classes)))
