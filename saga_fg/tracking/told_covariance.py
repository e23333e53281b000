r"""How sure of its position a track is told to be: the filter's covariance, as it was found to compare with labels.

    P_told = ( c (1 + h (1 - p)) )^2 P + ( e (1 + g (1 - p)) )^2 u u^T

A filter's noise is wider than its errors where it also has to let the right detections through the gate, which are not
as Gaussian as it takes them for: the factor c, of sensor and class, is for that, and h for what else the probability p
of the latest detection says. On the other hand a detector that sees one side of a car misjudges its length, and with it
the place of its centre along the heading u, in one frame as in the next. No filter averages that away: the shared error
e. Both are for what is told; the filter and the association, which compare detections with detections, do without them.
c, e and their growth are the sensor's noise settings, see `saga_fg.types.sensor`.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray


def told_covariance(P: FloatArray, yaw: FloatArray, factor: FloatArray, shared: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2), m^2, of positions as they are told.

    P (n, 2, 2), yaw (n,), factor (n,) on the deviations, shared (n,) error, m. Where the heading is unknown, half of
    the shared variance goes to each axis.
    """
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    direction = np.where(np.isfinite(yaw)[:, None, None], ahead[:, :, None] * ahead[:, None], np.eye(2) / 2)
    return np.asarray(factor[:, None, None] ** 2 * P + shared[:, None, None] ** 2 * direction)
