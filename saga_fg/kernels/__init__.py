"""Loops over tracks, nodes and pairs, compiled by Numba. See `saga_fg.kernels.compilation`.

Each is the only implementation of what its docstring states. Tests compare it with the textbook, and compiled with the
same function as plain Python.
"""
