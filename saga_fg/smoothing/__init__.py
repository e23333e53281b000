"""Offline smoothing: from tracks of a recording to labels, with past and future of every box."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
