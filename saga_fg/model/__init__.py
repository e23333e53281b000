"""The mathematical model: nodes, their motion, interactions, edge rules, sensors, landmarks; plain NumPy."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
