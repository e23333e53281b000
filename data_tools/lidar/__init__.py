"""LiDAR geometry: scans from files, de-skew, thinning, registration, ground, walls, poles.

Points are arrays (N, 3) in m. Unless a function says otherwise they are in the sensor's frame: x ahead, y left, z up.
Open3D is imported for compressed PCD files, and for points in boxes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
