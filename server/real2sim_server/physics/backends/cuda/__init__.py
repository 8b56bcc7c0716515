"""The CUDA backend: the same blocks and per-particle functions on an NVIDIA GPU."""
