"""saga-fg: factor-graph filters and smoothers for many interacting objects."""

from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version("saga-fg")

ABOVE = {"evaluate": "data_tools.datasets.detection_file_source:evaluate", "view": "pipelines.report.page:view"}
"""Functions of packages above this one, found by name when they are first asked for, as the command is."""


def __getattr__(name):
    if not name.startswith("__"):
        _check_factors()
    return resolve_name(ABOVE[name]) if name in ABOVE else _attribute(name)


@cache
def _check_factors():
    """Raise `ImportError` where Python finds another package `factors` before the one that came with this; run none."""
    own, spec = Path(__file__).resolve().parents[1] / "factors", find_spec("factors")
    places = (
        [] if spec is None else [Path(place).resolve() for place in spec.submodule_search_locations or [spec.origin]]
    )
    if own not in places:
        raise ImportError(
            f"saga_fg needs its package factors in {own.parent}, and Python finds {places[0] if places else 'none'}; "
            "rename that, or start elsewhere or with `python -P`"
        )
