r"""Anderson acceleration: x = g(x) found from fewer evaluations of g.

Iteratively reweighted least squares converges linearly, slowly where a robust loss holds many measurements down. From
the last evaluations, with f_i = g(x_i) - x_i, the next point is

    x = sum_i a_i g(x_i),     a = argmin || sum_i a_i f_i ||,  sum_i a_i = 1

Where the step grew, the memory is dropped and the plain step is taken. Source: Walker and Ni, Anderson acceleration for
fixed-point iterations, SIAM J. Numerical Analysis 49 (2011).
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray

_MEMORY = 6  # evaluations that are kept
_GROWTH = 2.0  # of the step, from which the memory misleads


class AndersonAcceleration:
    """The memory of an iteration."""

    def __init__(self) -> None:
        self._images: list[FloatArray] = []
        self._steps: list[FloatArray] = []

    def next(self, x: FloatArray, image: FloatArray, scale: FloatArray) -> FloatArray:
        """The point at which to evaluate next, given `image` = g(x) (D,); `scale` (D,): the unit of each entry."""
        step = (image - x) / scale
        if self._steps and np.abs(step).max(initial=0.0) > _GROWTH * np.abs(self._steps[-1]).max(initial=0.0):
            self._images, self._steps = [], []
        self._images, self._steps = [*self._images, image][-_MEMORY:], [*self._steps, step][-_MEMORY:]
        if len(self._steps) == 1:
            return image
        differences = np.diff(np.array(self._steps), axis=0).T
        gamma = np.linalg.lstsq(differences, step, rcond=1e-12)[0]
        return np.asarray(image - np.diff(np.array(self._images), axis=0).T @ gamma)
