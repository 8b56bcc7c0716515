"""The CPU backend: Numba kernels on grid blocks, on all cores."""
