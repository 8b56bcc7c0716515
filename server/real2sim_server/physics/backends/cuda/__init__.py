"""The CUDA backend: kernels of our own by NVRTC, laws and contact from the source of the CPU."""
