"""The CUDA backend: NVRTC kernels that share constitutive laws and contact with the CPU."""
