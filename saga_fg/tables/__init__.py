"""Tables of detections, of files and programs: what their columns mean, whether that is plausible, and their frames."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
