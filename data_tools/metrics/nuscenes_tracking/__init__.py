"""The metrics of the nuScenes tracking task, equal to the official evaluation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
