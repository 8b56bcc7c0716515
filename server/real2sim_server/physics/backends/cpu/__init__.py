"""The CPU backend: blocks of the grid as Numba kernels on all cores."""
