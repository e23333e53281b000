"""Simulated traffic as a dataset of the command."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

from data_tools.datasets.parts import HeldScene, OpenedPart, Parts
from data_tools.datasets.source import DatasetSource, option
from data_tools.simulator.scene import SimulatedTraffic
from data_tools.simulator.settings import SimulatorSettings
from saga_fg.types.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class SimulatedSource(DatasetSource):
    """Simulated traffic, whose ground truth has the hidden objects too."""

    name = "simulated"
    family = "simulated"
    example = "--scenes 2 --seed 0"
    scenes: int = option("Number of scenes.", 4, least=1)
    seed: int = option("The same seed makes the same scenes.", 0, least=0)
    simulator: SimulatorSettings | None = option("YAML file; see `saga-fg config --simulator`.", None, metavar="FILE")

    @contextmanager
    def open(self, truth: bool = False) -> Iterator[Dataset]:
        yield SimulatedTraffic(self.simulator, self.scenes, self.seed)

    def restricted(self, scenes: Collection[str]) -> Self:
        numbers = (re.fullmatch(r"scene-([0-9]{4,6})", name) for name in scenes)
        last = max((int(number[1]) for number in numbers if number), default=1)
        return replace(self, scenes=max(last, 1))

    @contextmanager
    def parts(self) -> Iterator[Parts]:
        scenes = SimulatedTraffic(self.simulator, self.scenes, self.seed).scenes
        yield Parts(scenes, (SimulatedScene(self, name) for name in scenes))


@dataclass(frozen=True)
class SimulatedScene:
    """Scene `name` of simulated traffic, made at the worker."""

    source: SimulatedSource
    name: str

    @contextmanager
    def opened(self) -> Iterator[OpenedPart]:
        """Open with the digest of the settings, seed and name."""
        made_from = f"{self.source.simulator or SimulatorSettings()!r} {self.source.seed} {self.name}"
        yield OpenedPart({"simulator": hashlib.sha256(made_from.encode()).hexdigest()}, self._read)

    def _read(self) -> Dataset:
        source = self.source
        return HeldScene(SimulatedTraffic(source.simulator, source.scenes, source.seed).scene(self.name))
