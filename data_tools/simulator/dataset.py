"""Simulated scenes as a dataset."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from data_tools.datasets.parts import HeldScene, OpenedPart, Parts
from data_tools.datasets.source import DatasetSource, option
from data_tools.simulator.scene import simulate_scene
from data_tools.simulator.settings import SimulatorSettings
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene


class SimulatedTraffic:
    """A dataset of simulated scenes, made when they are asked for: the same ones for the same settings and seed.

    The first scenes of a larger dataset are those of a smaller one. Raises `InputError` for less than one scene and
    for a negative seed.
    """

    def __init__(self, settings: SimulatorSettings | None = None, scenes: int = 4, seed: int = 0) -> None:
        for name, value, least in (("scenes", scenes, 1), ("seed", seed, 0)):
            if value < least:
                raise InputError(f"{name}: expected a number of at least {least}, got {value}")
        self._settings = settings or SimulatorSettings()
        self._seeds = {
            f"scene-{k + 1:04d}": int(np.random.SeedSequence([seed, k]).generate_state(1)[0]) for k in range(scenes)
        }

    @property
    def settings(self) -> SimulatorSettings:
        """What the scenes are made with."""
        return self._settings

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the scenes."""
        return tuple(self._seeds)

    def scene(self, name: str) -> Scene:
        """Simulate one scene; raises `InputError` for an unknown name."""
        if name not in self._seeds:
            raise InputError(f"scene {name!r}: expected one of {', '.join(self._seeds)}")
        return simulate_scene(self._settings, self._seeds[name], name)


@dataclass(frozen=True, kw_only=True)
class SimulatedSource(DatasetSource):
    """Simulated traffic, whose truth is known: hidden objects are scored as well."""

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
        """With the digest of what the scene is made from."""
        made_from = f"{self.source.simulator or SimulatorSettings()!r} {self.source.seed} {self.name}"
        yield OpenedPart({"simulator": hashlib.sha256(made_from.encode()).hexdigest()}, self._read)

    def _read(self) -> Dataset:
        source = self.source
        return HeldScene(SimulatedTraffic(source.simulator, source.scenes, source.seed).scene(self.name))
