"""Loops over tracks, nodes and pairs, compiled by Numba where that is installed (`saga_fg[fast]`).

Each does what a NumPy version beside its call does as well, which is used without Numba and which tests compare it
with. See `saga_fg.kernels.compilation`.
"""
