"""The CUDA backend of cast(): kernels of our own, compiled by NVRTC."""
