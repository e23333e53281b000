"""Datasets by name: those that come along, those of installed packages, and MODULE:CLASS.

A package offers a `DatasetSource` through the entry point group `saga_fg.datasets`:

    [project.entry-points."saga_fg.datasets"]
    mine = "my_package.my_module:Mine"
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

from data_tools.datasets.source import DatasetSource
from data_tools.files.error_messages import unknown_name
from saga_fg.errors import InputError

GROUP = "saga_fg.datasets"
BUILT_IN = {
    "nuscenes": "data_tools.datasets.nuscenes.source:NuScenesSource",
    "kitti": "data_tools.datasets.kitti.source:KittiSource",
    "argoverse2": "data_tools.datasets.argoverse2.source:ArgoverseSource",
    "eth_ucy": "data_tools.datasets.eth_ucy:EthUcySource",
    "mcap": "data_tools.datasets.mcap.source:McapSource",
    "file": "data_tools.datasets.detection_file_source:DetectionFileSource",
    "simulated": "data_tools.simulator.source:SimulatedSource",
}


def dataset_names() -> tuple[str, ...]:
    """The names of all datasets, those that come along first."""
    return (*BUILT_IN, *(name for name in external_datasets() if name not in BUILT_IN))


def dataset_source(name: str) -> type[DatasetSource]:
    """The dataset of a name, or of MODULE:CLASS.

    Raises `InputError` for an unknown name, a name that several packages give, and for what cannot be imported or is no
    dataset, naming the package.
    """
    if ":" in name:
        return _loaded(name, f"dataset {name}")
    if name in BUILT_IN and name not in external_datasets():
        return _loaded(BUILT_IN[name], f"dataset {name}")
    found = external_datasets().get(name, ())
    if not found:
        raise InputError(unknown_name("dataset", name, dataset_names()))
    packages = [entry.dist.name if entry.dist is not None else entry.value for entry in found]
    packages += ["saga-fg"] * (name in BUILT_IN)
    if len(packages) > 1:
        raise InputError(f"dataset {name}: expected one package to offer it, {' and '.join(packages)} do")
    return _loaded(found[0].value, f"dataset {name} of the package {packages[0]}")


@cache
def external_datasets() -> dict[str, tuple[EntryPoint, ...]]:
    """The entry points of installed packages, by name."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)):
        found[entry.name] = (*found.get(entry.name, ()), entry)
    return found


def _loaded(location: str, what: str) -> type[DatasetSource]:
    module, _, attribute = location.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except Exception as error:  # the module is somebody else's code
        raise InputError(f"{what}: {location} cannot be loaded: {type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, DatasetSource)):
        raise InputError(f"{what}: {location}: expected a class derived from DatasetSource")
    return found
