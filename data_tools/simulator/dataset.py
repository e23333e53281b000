"""Simulated scenes as a dataset."""

from __future__ import annotations

import numpy as np

from data_tools.simulator.scene import simulate_scene
from data_tools.simulator.settings import SimulatorSettings
from saga_fg.errors import InputError
from saga_fg.types.dataset import Scene


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
