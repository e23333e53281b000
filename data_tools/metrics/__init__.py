"""Metrics of tracks against ground truth, both in memory; they read no files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
