"""The CPU backend of cast(): Numba kernels on all cores."""
