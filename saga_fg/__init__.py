"""saga-fg: factor-graph filters and smoothers for many interacting objects."""

from importlib.metadata import version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version("saga-fg")
