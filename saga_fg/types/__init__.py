"""Values that go through the pipeline: boxes, frames of detections, road maps, tracks, datasets."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
