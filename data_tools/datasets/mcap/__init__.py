"""Recordings of ROS 2: files of MCAP, and bag folders with MCAP or SQLite in them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
