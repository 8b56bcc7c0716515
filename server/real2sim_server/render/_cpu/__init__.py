"""The CPU backend: Numba kernels on all cores."""
